"""Words for the objects of a scene: colours, nouns, and containers."""

from __future__ import annotations

from demorec.episode.scene import Body

COLOR_WORDS = ("red", "green", "blue", "yellow", "orange", "purple", "black", "white", "grey")
"""Words for colours in instructions and names."""
VESSELS = ("tray", "bowl")
"""Nouns of containers, which take "in" and "into" instead of "on" and "onto"."""
NOUNS = {
    **{noun: noun for noun in ("cube", "block", "cylinder", "duck", "mug")},
    "jenga": "wooden plank",
    "lego": "toy brick",
}
"""Word in a body's name -> its noun in instructions."""
_SYNONYMS = {
    "target": ("target", "mark", "square"),
    "mark": ("mark", "target", "square"),
    "tray": ("tray",),
}


def nouns_of(body: Body) -> tuple[str, ...]:
    """Return the nouns for a body, the usual one first: from its name, less colour and number, and from its shape."""
    words = [word for word in body.name.split("_") if not word.isdigit() and word not in (*COLOR_WORDS, "other")]
    noun = " ".join(NOUNS.get(word, word) for word in words) or "object"
    nouns = _SYNONYMS.get(noun, (noun,))
    x, y, z = body.shape.extents
    if body.movable and body.shape.kind == "box":
        nouns += ("cube",) if max(x, y, z) < 1.05 * min(x, y, z) else ("block",)
    elif body.movable and body.shape.kind in ("cylinder", "sphere", "capsule"):
        nouns += (body.shape.kind,)
    return tuple(dict.fromkeys(nouns))
