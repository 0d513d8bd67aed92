"""Questions about single images with exact answers, and the way that the TCP is about to take in them.

Answers have the shapes that LeRobot's validator knows (bbox, keypoint, count, attribute, spatial). A question is
asked only where the answer is beyond doubt: of what is visible enough, in words that mean one thing.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.annotate import Statement
from demorec.annotate.grounding import MIN_PIXELS, Seen, body_labels, pixels_of, project, seen_things
from demorec.annotate.referring import phrases_for
from demorec.annotate.situation import CONTAINERS, NamedThing, Surroundings, situations
from demorec.core.geometry import Array
from demorec.episode.episode import Columns
from demorec.episode.scene import SceneCamera
from demorec.mcap import Recording

Exchange = tuple[str, dict[str, Any]]
"""A question and its answer."""
ANSWERS = {
    "bbox": {"detections"},
    "keypoint": {"label", "point_format", "point"},
    "count": {"label", "count"},
    "attribute": {"label", "attribute", "value"},
    "spatial": {"subject", "relation", "object"},
}
"""Kind of question -> what its answer has at least."""
_CLEARLY_BESIDE = 0.05
"""Share of the image's width by which one thing must be farther to a side than another to be called so."""
_SIDES = frozenset(("left", "right", "leftmost", "rightmost"))
_TRACE_SECONDS, _TRACE_POINTS = 1.0, 5
_TOUCHING = 0.01
"""Metres of air above a support below which a thing is on it or in it."""


def _phrases(name: str, now: Surroundings) -> Iterator[str]:
    """Phrases for a thing without the robot's left and right, which a camera may see the other way round."""
    return (phrase for phrase in phrases_for(name, now) if not _SIDES & set(phrase.split()))


@lru_cache(maxsize=1024)  # several cameras look at one moment
def _phrase(name: str, now: Surroundings) -> str:
    """The plainest of them, "" where there is none."""
    return next(_phrases(name, now), "")


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """One image with all that is known of it; `middles` are where those of the things are in it, px."""

    camera: SceneCamera
    seen: dict[str, Seen]
    now: Surroundings
    middles: dict[str, Array]

    @cached_property
    def clear(self) -> dict[str, str]:
        """Name -> phrase of each thing that is visible enough to be spoken of, in words that mean it alone."""
        large = (name for name, thing in self.seen.items() if thing.num_pixels >= MIN_PIXELS)
        return {name: phrase for name in large if (phrase := _phrase(name, self.now))}


def questions(
    recording: Recording,
    columns: Columns,
    rows: NDArray[np.intp],
    cameras: Sequence[str],
    asked: Mapping[int, int],
) -> Iterator[Statement]:
    """A question a second about each camera that has segmentation, of another kind each time, in order by camera.

    Args:
        recording, columns: The episode.
        rows: (T,) which of its frames the dataset has.
        cameras: Those of the dataset.
        asked: Row -> which question of a camera it is, of the rows at which questions are asked.

    Raises:
        RecordingError: The recording is damaged.
    """
    scene, frames = recording.info.scene, rows[list(asked)]
    chosen = {
        camera.name: (number, camera)
        for number, camera in enumerate(scene.cameras)
        if camera.name in cameras and recording.has_segmentation(camera.name)
    }
    if not chosen or not asked:
        return
    numbers, poses = body_labels(recording), {name: values[frames] for name, values in columns.object_poses.items()}
    moments = situations(scene, poses, len(frames))
    places = np.empty((len(frames), len(numbers), 3))
    for index, name in enumerate(numbers):
        places[:, index] = poses[name][:, :3] if name in poses else scene.body(name).world_from_body.position
    middles = {
        name: project(camera, columns.world_from_camera[name][frames], places) for name, (_, camera) in chosen.items()
    }
    of_frame = {int(frame): index for index, frame in enumerate(frames)}
    in_order = list(asked.items())
    found: dict[str, list[Statement]] = {name: [] for name in chosen}
    for name, frame, labels in recording.segmentation_at(list(chosen), of_frame):
        (number, camera), index = chosen[name], of_frame[frame]
        row, turn = in_order[index]
        view = _View(
            camera=camera,
            seen=seen_things(labels, numbers),
            now=moments[index],
            middles=dict(zip(numbers, middles[name][index], strict=True)),
        )
        if (exchange := _ask(view, turn + number)) is not None:
            text, answer = exchange
            found[name] += [
                Statement(row=row, kind="vqa", role="user", text=text, camera=name),
                Statement(row=row, kind="vqa", role="assistant", text=json.dumps(answer), camera=name),
            ]
    for of_camera in found.values():
        yield from of_camera


def _ask(view: _View, turn: int) -> Exchange | None:
    """The next kind of question that the image has an answer to; of one kind another one each time."""
    for step in range(len(_KINDS)):
        if found := list(_KINDS[(turn + step) % len(_KINDS)](view)):
            return found[turn // len(_KINDS) % len(found)]
    return None


def _bbox(view: _View) -> Iterator[Exchange]:
    for name, phrase in view.clear.items():
        found = {"label": phrase, "bbox_format": "xyxy", "bbox": list(view.seen[name].box)}
        yield f"Where is {phrase}?", {"detections": [found]}


def _keypoint(view: _View) -> Iterator[Exchange]:
    pixels, inside = pixels_of(view.camera, np.array([view.middles[name] for name in view.clear]).reshape(-1, 2))
    for (name, phrase), pixel, is_inside in zip(view.clear.items(), pixels.tolist(), inside.tolist(), strict=True):
        if is_inside and view.seen[name].is_at(*pixel):
            yield f"Point at the middle of {phrase}.", {"label": phrase, "point_format": "xy", "point": pixel}


def _count(view: _View) -> Iterator[Exchange]:
    nouns: dict[str, list[int]] = {}
    for thing in view.now.things:
        if thing.name in view.seen:
            for noun in thing.nouns:
                nouns.setdefault(noun, []).append(view.seen[thing.name].num_pixels)
    for noun in sorted(nouns):
        if min(nouns[noun]) >= MIN_PIXELS:
            yield f"How many {noun}s are visible?", {"label": noun, "count": len(nouns[noun])}


def _attribute(view: _View) -> Iterator[Exchange]:
    for name in view.clear:
        thing = view.now.thing(name)
        plain = (phrase for phrase in _phrases(name, view.now) if thing.color not in phrase.split())
        if thing.color and (phrase := next(plain, "")):
            yield f"What colour is {phrase}?", {"label": phrase, "attribute": "color", "value": thing.color}


def _spatial(view: _View) -> Iterator[Exchange]:
    for (name, subject), (other, object_) in permutations(view.clear.items(), 2):
        if relation := _relation(view, name, other):
            answer = {"subject": subject, "relation": relation, "object": object_}
            yield f"Where is {subject} relative to {object_}, as the camera sees it?", answer


def _relation(view: _View, name: str, other: str) -> str:
    """ "on" or "in" by where the things are, else "left_of" or "right_of" by where the image shows their middles."""
    lower = view.now.thing(other)
    if rests_on(view.now.thing(name), lower):
        return "in" if lower.noun in CONTAINERS else "on"
    if rests_on(lower, view.now.thing(name)):
        return ""
    offset = float(view.middles[name][0] - view.middles[other][0]) / view.camera.width
    if not abs(offset) >= _CLEARLY_BESIDE:
        return ""
    return "left_of" if offset < 0 else "right_of"


def rests_on(upper: NamedThing, lower: NamedThing) -> bool:
    """Whether one thing's middle is above the other and no air is between them."""
    offset = upper.position - lower.position
    air = float(offset[2]) - upper.height / 2 - lower.height / 2
    within = lower.size / 2 if not lower.can_be_held else lower.size * 0.7
    return -2 * _TOUCHING < air < _TOUCHING and float(np.abs(offset[:2]).max()) < within


_KINDS: tuple[Callable[[_View], Iterator[Exchange]], ...] = (_bbox, _keypoint, _count, _attribute, _spatial)


def traces(
    recording: Recording,
    columns: Columns,
    rows: NDArray[np.intp],
    cameras: Sequence[str],
    asked: Mapping[int, int],
) -> Iterator[Statement]:
    """The next second of the TCP in each camera's image, once a second, in order by camera.

    Points are where the image of that moment would show the TCP; the trace ends where it leaves the image, and
    there is none where it begins outside. Arguments as of `questions`.
    """
    info, frames = recording.info, rows[list(asked)]
    steps = np.linspace(0.0, _TRACE_SECONDS * info.fps, _TRACE_POINTS + 1).round().astype(int)
    world_from_tcp = info.scene.robot.world_from_base.apply(columns.base_from_tcp[:, :3])
    for camera in info.scene.cameras:
        if camera.name not in cameras or not asked:
            continue
        tcp = world_from_tcp[np.minimum(frames[:, np.newaxis] + steps, columns.num_frames - 1)]
        projected = project(camera, columns.world_from_camera[camera.name][frames], tcp)
        pixels, inside = pixels_of(camera, projected)
        counts = np.logical_and.accumulate(inside, axis=1).sum(axis=1).tolist()
        for row, points, count in zip(asked, pixels.tolist(), counts, strict=True):
            if count:
                answer = {
                    "label": "gripper",
                    "point_format": "xy",
                    "points": points[:count],
                    "seconds": _TRACE_SECONDS,
                }
                yield Statement(row=row, kind="trace", role="assistant", text=json.dumps(answer), camera=camera.name)
