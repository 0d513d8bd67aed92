"""Text for Rerun's viewer without a screen, which ends at the first character that its two fonts lack.

The window takes such characters from the system's fonts and a browser has its own, so only pictures need this.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from demorec.playback.episode import PlayedCollected, PlayedEpisode
from demorec.playback.sources import PlaybackSource

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

BOX = "□"
DRAWABLE = (
    "\t\n -~\u00a0-\u00ac\u00ae-\u0148\u014a-\u017f"  # Latin: Western, Central and Northern European
    "\u0391-\u03a1\u03a3-\u03ce\u0401-\u040c\u040e-\u044f\u0451-\u045c\u045e\u045f"  # Greek, Cyrillic
    "\u2013\u2014\u2018-\u201e\u2022\u2026\u20ac\u2122\u2190-\u2193\u2212\u2248\u2260\u2264\u2265\u25a1\u2713\u2717"
)
"""What both fonts have (that for running text and that for numbers), as the inside of a regular expression's brackets;
a test shows all of it to the viewer."""

_MISSING = re.compile(f"[^{DRAWABLE}]")


class DrawableText:
    """Makes text drawable, and remembers what was missing.

    Attributes:
        missing: Characters that were replaced.
    """

    def __init__(self) -> None:
        self.missing: set[str] = set()

    def sentence(self, text: str) -> str:
        """The text with a box in place of every character that cannot be drawn."""
        return self._replaced(text, lambda character: BOX)

    def name(self, text: str) -> str:
        """The text with such characters as code points (U+4E2D), so that different names stay different."""
        return self._replaced(text, lambda character: f"U+{ord(character):04X}")

    def _replaced(self, text: str, spell: Callable[[str], str]) -> str:
        text = unicodedata.normalize("NFC", text)
        self.missing.update(_MISSING.findall(text))
        return _MISSING.sub(lambda found: spell(found[0]), text)

    def source(self, source: PlaybackSource) -> PlaybackSource:
        """The same episode, with drawable text wherever a layout shows text."""

        @contextmanager
        def opened() -> Iterator[PlayedEpisode | PlayedCollected]:
            with source.open() as episode:
                yield self.episode(episode)

        return PlaybackSource(name=source.name, open=opened)

    def episode(self, episode: PlayedEpisode | PlayedCollected) -> PlayedEpisode | PlayedCollected:
        """The same with drawable text."""
        if isinstance(episode, PlayedCollected):
            told = self._spelt(episode.info, sentences=("instruction",))
            return self._spelt(episode, sentences=("name", "group"), info=told)
        scene, outcome = episode.info.scene, episode.outcome
        bodies = {self.name(body.name): body.name for body in scene.bodies}
        scene = replace(
            scene,
            bodies=tuple(self._spelt(body, names=("name",)) for body in scene.bodies),
            goals=tuple(self._spelt(goal, names=("object", "onto")) for goal in scene.goals),
            cameras=tuple(self._spelt(camera, names=("name",)) for camera in scene.cameras),
        )
        if outcome is not None:
            checks = tuple(self._spelt(check, sentences=("name", "unit")) for check in outcome.checks)
            outcome = self._spelt(outcome, sentences=("failure_phase", "failure_reason"), checks=checks)
        return self._spelt(
            episode,
            sentences=("name", "group"),
            names=("object_poses", "end_poses", "world_from_camera", "phase", "videos", "depth", "segmentation"),
            info=self._spelt(episode.info, sentences=("task", "instruction", "origin"), scene=scene),
            outcome=outcome,
            body_description=lambda body: episode.body_description(bodies[body]),
            events=tuple((time, self._spelt(event, sentences=("name", "message"))) for time, event in episode.events),
            curves={name: self._spelt(curves, names=("names",)) for name, curves in episode.curves.items()},
            segment_names={number: self.name(name) for number, name in episode.segment_names.items()},
        )

    def _spelt[T: DataclassInstance](
        self, value: T, *, sentences: Sequence[str] = (), names: Sequence[str] = (), **others: object
    ) -> T:
        """A dataclass with drawable text in some of its fields: sentences, and names, tuples or keys of names."""
        spelt: dict[str, Any] = {field: self.sentence(getattr(value, field)) for field in sentences}
        for field in names:
            held = getattr(value, field)
            if isinstance(held, str):
                spelt[field] = self.name(held)
            elif isinstance(held, tuple):
                spelt[field] = tuple(map(self.name, held))
            else:
                spelt[field] = {self.name(key): item for key, item in held.items()}
        return replace(value, **spelt, **others)
