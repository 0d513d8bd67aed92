"""Text for Rerun's viewer without a screen, which ends at the first character that its two fonts lack.

The window takes such characters from the system's fonts and a browser has its own, so only screenshots need this.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from typing import Any

from demorec.view.episode import PlayedEpisode
from demorec.view.sources import PlaybackSource

DRAWABLE = (
    "\t\n -~\u00a0-\u00ac\u00ae-\u0148\u014a-\u017f"  # Latin: Western, Central and Northern European
    "\u0391-\u03a1\u03a3-\u03ce\u0401-\u040c\u040e-\u044f\u0451-\u045c\u045e\u045f"  # Greek, Cyrillic
    "\u2013\u2014\u2018-\u201e\u2022\u2026\u20ac\u2122\u2190-\u2193\u2212\u2248\u2260\u2264\u2265\u25a1\u2713\u2717"
)
"""What both fonts have (that for running text and that for numbers), as the inside of a regular expression's brackets;
a test shows all of it to the viewer."""

_MISSING = re.compile(f"[^{DRAWABLE}]")


def drawable(value: Any, missing: set[str]) -> Any:
    """The same with code points (U+4E2D) for what cannot be drawn, in all text of dataclasses, tuples, lists and dicts.

    Args:
        value: Names in it stay different and belong together as before; names of files stay as they are.
        missing: Takes the characters that were replaced.
    """
    if isinstance(value, str):
        text = unicodedata.normalize("NFC", value)
        missing.update(_MISSING.findall(text))
        return _MISSING.sub(lambda found: f"U+{ord(found[0]):04X}", text)
    if isinstance(value, (tuple, list)):
        return type(value)(drawable(item, missing) for item in value)
    if isinstance(value, Mapping):
        return {drawable(key, missing): drawable(item, missing) for key, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in fields(value) if field.init and field.name != "file"]
        return replace(value, **{name: drawable(getattr(value, name), missing) for name in names})
    return value


def drawable_source(source: PlaybackSource, missing: set[str]) -> PlaybackSource:
    """The same episode with drawable text; `missing` takes what was replaced."""

    @contextmanager
    def opened() -> Iterator[PlayedEpisode]:
        with source.open() as episode:
            spelt = drawable(episode, missing)
            if episode.scene is not None:  # models are looked for by their own names
                bodies = {drawable(body.name, missing): body.name for body in episode.scene.bodies}
                spelt = replace(
                    spelt,
                    info=spelt.info.with_simulation(robot=episode.info.robot),
                    joint_position=episode.joint_position,
                    body_description=lambda name: episode.body_description(bodies[name]),
                )
            yield spelt

    return PlaybackSource(name=source.name, open=opened)
