"""Episodes of a LeRobot dataset, measured one by one: what their comparison needs, a few kB each."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.evidence import Motion, motions_of_dataset
from demorec.check.scoring.movement import Movement, Scale, movement, scale_of
from demorec.check.scoring.sight import Sight, sight
from demorec.core.errors import ExportError, without_path
from demorec.datasets.editing.content import row_hashes
from demorec.datasets.lerobot.episodes import LeRobotDataset
from demorec.datasets.lerobot.recording import DatasetRecording
from demorec.episode.features import ACTION, STATE

_FEWEST_FRAMES = 8
_GAP = 1.5
"""Times the usual step from one frame to the next: more is a gap."""
_SKETCH = 64
"""Rows whose hashes stand for an episode: those of the smallest hashes, the same ones wherever these rows are."""


@dataclass(frozen=True, kw_only=True)
class Reason:
    """Why something is taken off: the factor that is left, in words, the first and the last frame."""

    kind: str
    factor: float
    text: str
    first: int
    last: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """One episode.

    Attributes:
        episode_index, length, task: As the dataset has them.
        flaws: What is wrong in itself, whatever others do.
        movement: None without a state, and where numbers are missing.
        sights: Camera -> what is seen.
        sketch: (N,) hashes of some rows of state and action.
    """

    episode_index: int
    length: int
    task: str
    flaws: tuple[Reason, ...]
    movement: Movement | None
    sights: Mapping[str, Sight]
    sketch: NDArray[np.uint64]


def dataset_scale(root: Path) -> Scale | None:
    """What the elements range over in a dataset; None where no episode has a usable state."""
    dataset = _opened(root)
    motions = (_motion(dataset, dataset.rows.numbers(place)) for place in dataset.places)
    return scale_of(motion for motion in motions if motion is not None)


def measure(root: Path, scale: Scale | None, images: bool, numbers: Sequence[int]) -> list[Measured]:
    """Some episodes of a dataset, in order; ExportError when its tables cannot be read."""
    dataset = _opened(root)
    return [_measured(dataset, scale, number, images=images) for number in numbers]


@functools.lru_cache(maxsize=1)
def _opened(root: Path) -> LeRobotDataset:
    return LeRobotDataset(root)


def _motion(dataset: LeRobotDataset, rows: Mapping[str, NDArray[Any]]) -> Motion | None:
    """None where there is no state, a number of it is missing, or the episode is very short."""
    numbers = [rows[name] for name in (STATE, ACTION) if name in rows]
    if STATE not in rows or len(rows[STATE]) < _FEWEST_FRAMES or not all(np.isfinite(part).all() for part in numbers):
        return None
    return next(motions_of_dataset(dataset.info, [rows], {}, ""), None)


def _measured(dataset: LeRobotDataset, scale: Scale | None, number: int, *, images: bool) -> Measured:
    place, fps = dataset.places[number], float(dataset.info.fps)
    rows = dataset.rows.numbers(place)
    motion = None if scale is None else _motion(dataset, rows)
    moved = None if motion is None or scale is None else movement(motion, scale)
    flaws = [
        Reason(kind=kind, factor=0.0, text=text, first=first, last=last)
        for kind, text, first, last in _flaws(rows, place.length, fps)
    ]
    sights: dict[str, Sight] = {}
    recording = DatasetRecording(dataset, number)
    for camera in recording.cameras if images and place.length else ():
        try:
            images_at = partial(recording.images_at, camera)
            sights[camera] = sight(images_at, place.length, fps, () if moved is None else moved.grips)
        except ExportError as error:
            text = without_path(error, dataset.root)
            flaws.append(Reason(kind="images", factor=0.0, text=text, first=0, last=place.length - 1))
    return Measured(
        episode_index=place.episode_index,
        length=place.length,
        task="; ".join(place.tasks),
        flaws=tuple(flaws),
        movement=moved,
        sights=sights,
        sketch=_sketch(rows),
    )


def _flaws(rows: Mapping[str, NDArray[Any]], length: int, fps: float) -> Iterator[tuple[str, str, int, int]]:
    """(kind, what is wrong in words, first and last frame) of the numbers."""
    if length < _FEWEST_FRAMES:
        yield "length", f"has {length} frames", 0, max(length - 1, 0)
    for name in (STATE, ACTION):
        if name in rows and rows[name].dtype.kind == "f" and not (finite := np.isfinite(rows[name]).all(axis=1)).all():
            frames = np.flatnonzero(~finite)
            yield "missing", f"lacks numbers of {name} in {len(frames)} frames", int(frames[0]), int(frames[-1])
    steps = np.diff(rows["timestamp"][:, 0].astype(np.float64)) * fps
    odd = np.flatnonzero(~((steps > 2 - _GAP) & (steps < _GAP)))
    if len(odd):
        frame = int(odd[0])
        text = f"has {len(odd)} odd steps of time, of {steps[frame] / fps:.3f} s where {1 / fps:.3f} s are usual"
        yield "timing", text, frame, int(odd[-1]) + 1


def _sketch(rows: Mapping[str, NDArray[Any]]) -> NDArray[np.uint64]:
    numbers = [rows[name] for name in (STATE, ACTION) if name in rows and rows[name].dtype.kind in "fiub"]
    if not numbers:
        return np.zeros(0, np.uint64)
    return np.unique(row_hashes(np.concatenate(numbers, axis=1)))[:_SKETCH]
