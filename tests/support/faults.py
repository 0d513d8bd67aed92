"""Faults of recordings that need no file: good numbers or images with one thing wrong, and what a check says."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Result
from demorec.check.cells import CellGrid, ImageKind
from demorec.check.drawn import ImageComparison
from demorec.check.episode import CheckedEpisode
from demorec.check.summary import ImageSummary
from demorec.core.tables import CHECKS
from demorec.episode.episode import Columns, Outcome
from demorec.episode.info import EpisodeInfo
from demorec.episode.scene import SceneCamera
from demorec.mcap import Recording

Rows = NDArray[Any]


@dataclass
class Good:
    """A good recording, kept open, with its decoded images.

    Attributes:
        episode: As the checks see it; drawn once.
        images: (camera, kind) -> (T, H, W[, 3]).
    """

    episode: CheckedEpisode
    images: Mapping[tuple[str, ImageKind], Rows] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path) -> Good:
        """Read and decode everything."""
        episode = CheckedEpisode(path)
        recording, images = episode.recording, {}
        for camera in episode.cameras:
            for kind in episode.kinds(camera.name):
                read: Callable[[str], Any] = {
                    "color": recording.images, "depth": recording.depth, "labels": recording.segmentation,
                }[kind]  # fmt: skip
                images[camera.name, kind] = np.stack(list(read(camera.name)))
        return cls(episode, images)

    @property
    def _cameras(self) -> dict[str, SceneCamera]:
        return {camera.name: camera for camera in self.episode.cameras}

    def with_images(self, changed: Mapping[tuple[str, ImageKind], Rows]) -> CheckedEpisode:
        """The episode with other images; what is drawn of it stays."""
        spoilt = CheckedEpisode(self.episode.path)
        spoilt.__dict__["recording"] = _WithImages(self.episode.recording, changed)
        spoilt.__dict__["columns"] = self.episode.columns
        spoilt.__dict__["_drawn"] = self.episode._drawn
        spoilt.__dict__["sampled"] = self.episode.sampled
        spoilt.__dict__["_drawn_full_size"] = self.episode._drawn_full_size
        for key in self.images.keys() - changed.keys():
            spoilt._images[key] = self.episode.images(self._cameras[key[0]], key[1])
            compared = self.episode.compared(self._cameras[key[0]], key[1])
            assert isinstance(compared, ImageComparison)
            spoilt._comparisons[key] = compared
        for (name, kind), images in changed.items():
            grid = CellGrid(images.shape[2], images.shape[1])
            cells = np.stack([grid.read(kind, image).cells for image in images])
            nothing = np.zeros(len(images))
            spoilt._images[name, kind] = ImageSummary(
                error="",
                mean=np.zeros((len(images), 3)),
                dark=nothing,
                bright=nothing,
                cells=cells,
                detail=nothing.astype(np.float32),
                kept={} if kind == "color" else {frame: images[frame] for frame in self.episode.sampled[name]},
            )
        return spoilt


class _WithImages:
    """A recording with other colour images."""

    def __init__(self, recording: Recording, images: Mapping[tuple[str, ImageKind], Rows]) -> None:
        self._recording, self._images = recording, images

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)

    def images_at(self, camera: str, frames: Sequence[int]) -> Iterator[Rows]:
        """Those, or the recording's own."""
        if (camera, "color") not in self._images:
            return self._recording.images_at(camera, frames)
        return iter(self._images[camera, "color"][list(frames)])


@dataclass(frozen=True, kw_only=True, eq=False)
class Changed:
    """What is put in a recording's place; None leaves it."""

    columns: Columns
    info: EpisodeInfo
    outcome: Outcome

    def with_columns(self, **arrays: Any) -> Changed:
        """With other columns, which must differ."""
        for name, array in arrays.items():
            before = getattr(self.columns, name)
            pairs = [(before[key], array[key]) for key in array] if isinstance(array, dict) else [(before, array)]
            assert not all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs), f"{name} was not changed"
        return replace(self, columns=replace(self.columns, **arrays))

    def with_info(self, **fields: Any) -> Changed:
        """With another description, which must differ."""
        of_episode = {known.name for known in dataclasses.fields(EpisodeInfo)} & fields.keys()
        info = replace(self.info, **{name: fields.pop(name) for name in of_episode}).with_simulation(**fields)
        assert info != self.info
        return replace(self, info=info)

    def with_outcome(self, **fields: Any) -> Changed:
        """With another outcome, which must differ."""
        outcome = replace(self.outcome, **fields)
        assert outcome != self.outcome
        return replace(self, outcome=outcome)


Fault = Callable[[Changed], Changed]


def judged(path: Path, check: str, fault: Fault) -> Result:
    """What a check says of a recording with a fault in its numbers or in what is said about it."""
    with CheckedEpisode(path) as episode:
        recording = episode.recording
        assert recording.outcome is not None
        before = Changed(columns=recording.columns(), info=recording.info, outcome=recording.outcome)
        changed = fault(before)
        assert changed is not before
        episode.__dict__["columns"] = changed.columns
        recording.info, recording.outcome = changed.info, changed.outcome
        return CHECKS.load(check).run(episode)


def info(**fields: Any) -> Fault:
    """Another description."""
    return lambda c: c.with_info(**fields)


def outcome(**fields: Any) -> Fault:
    """Another outcome."""
    return lambda c: c.with_outcome(**fields)


def condition(name: str, **fields: Any) -> Fault:
    """Another result of a condition of success."""

    def fault(c: Changed) -> Changed:
        assert any(check.name == name for check in c.outcome.checks)
        return c.with_outcome(
            checks=tuple(replace(check, **fields) if check.name == name else check for check in c.outcome.checks)
        )

    return fault


def both_grippers(change: Callable[[Rows], Rows]) -> Fault:
    """Other actions and commands of the gripper."""
    return lambda c: c.with_columns(
        action_gripper=change(c.columns.action_gripper), command_gripper=change(c.columns.command_gripper)
    )


def late(rows: Rows) -> Rows:
    """One frame late, the first one twice."""
    return np.concatenate([rows[:1], rows[:-1]])


def halved(rows: Rows) -> Rows:
    """All values half as large."""
    return rows * 0.5


def inverted(rows: Rows) -> Rows:
    """The other sign."""
    return -rows


def upside_down(rows: Rows) -> Rows:
    """Large where it was small, within the same range."""
    return np.asarray(rows.max(axis=0) + rows.min(axis=0) - rows)


def backwards(rows: Rows) -> Rows:
    """The last frame first."""
    return rows[::-1].copy()


def frozen(rows: Rows) -> Rows:
    """As it was after a third, from then on."""
    out = rows.copy()
    out[len(out) // 3 :] = out[len(out) // 3]
    return out


def one_alien(rows: Rows) -> Rows:
    """One value of another time."""
    out = rows.copy()
    frame = 2 * len(out) // 3
    far = int(np.argmax(np.abs(rows - rows[frame]).reshape(len(rows), -1).max(axis=1)))
    out[frame] = rows[far]
    return out


def noisy(rows: Rows) -> Rows:
    """A tenth of the range of noise."""
    rng = np.random.default_rng(1)
    return np.asarray(rows + rng.normal(0.0, 0.1, rows.shape) * np.ptp(rows, axis=0))
