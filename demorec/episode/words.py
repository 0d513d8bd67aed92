"""Words for the objects of a scene: colours and containers."""

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
