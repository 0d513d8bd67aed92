"""Text for Rerun's viewer without a screen, which ends at the first character that its two fonts lack.

The window takes such characters from the system's fonts and a browser has its own, so only pictures need this.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

from demorec.playback.episode import PlayedCollected, PlayedEpisode
from demorec.playback.sources import PlaybackSource
from demorec.scene.episode import Outcome
from demorec.scene.scene import Scene

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
            told = replace(episode.info, instruction=self.sentence(episode.info.instruction))
            return replace(episode, name=self.sentence(episode.name), group=self.sentence(episode.group), info=told)
        info = episode.info
        bodies = {self.name(body.name): body.name for body in info.scene.bodies}
        return replace(
            episode,
            name=self.sentence(episode.name),
            group=self.sentence(episode.group),
            info=replace(
                info,
                task=self.sentence(info.task),
                instruction=self.sentence(info.instruction),
                origin=self.sentence(info.origin),
                scene=self._scene(info.scene),
            ),
            outcome=None if episode.outcome is None else self._outcome(episode.outcome),
            body_description=lambda body: episode.body_description(bodies[body]),
            object_poses=self._keys(episode.object_poses),
            end_poses=self._keys(episode.end_poses),
            world_from_camera=self._keys(episode.world_from_camera),
            phase=tuple(self.name(phase) for phase in episode.phase),
            events=tuple(
                (time_ns, replace(event, name=self.sentence(event.name), message=self.sentence(event.message)))
                for time_ns, event in episode.events
            ),
            curves={
                name: replace(curves, names=tuple(self.name(curve) for curve in curves.names))
                for name, curves in episode.curves.items()
            },
            videos=self._keys(episode.videos),
            depth=self._keys(episode.depth),
            segmentation=self._keys(episode.segmentation),
            segment_names={number: self.name(name) for number, name in episode.segment_names.items()},
        )

    def _keys[V](self, values: Mapping[str, V]) -> dict[str, V]:
        return {self.name(key): value for key, value in values.items()}

    def _scene(self, scene: Scene) -> Scene:
        return replace(
            scene,
            bodies=tuple(replace(body, name=self.name(body.name)) for body in scene.bodies),
            goals=tuple(
                replace(goal, object=self.name(goal.object), onto=self.name(goal.onto)) for goal in scene.goals
            ),
            cameras=tuple(replace(camera, name=self.name(camera.name)) for camera in scene.cameras),
        )

    def _outcome(self, outcome: Outcome) -> Outcome:
        return replace(
            outcome,
            failure_phase=self.sentence(outcome.failure_phase),
            failure_reason=self.sentence(outcome.failure_reason),
            checks=tuple(
                replace(check, name=self.sentence(check.name), unit=self.sentence(check.unit))
                for check in outcome.checks
            ),
        )
