"""LeRobot datasets become runs: every episode a recording, its numbers to the bit, its packets as they are.

The same command again goes on: episodes that are there are not written.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, in_words
from demorec.datasets.lerobot.data_stats import column_numbers
from demorec.datasets.lerobot.depth import DepthScale
from demorec.datasets.lerobot.files import table_batches
from demorec.datasets.lerobot.language import COLUMNS, PERSISTENT, spoken_episodes
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetFeature, DatasetInfo
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.datasets.lerobot.reader import EpisodePlace, RowReader, episode_places, read_tasks
from demorec.episode.external import (
    Camera,
    EpisodeInfo,
    Feature,
    Origin,
    SourceFile,
    Vector,
)
from demorec.episode.features import IMAGE_PREFIX
from demorec.mcap.external.frame_check import MAX_SUBTASK
from demorec.runs.external import open_external_run
from demorec.runs.find import expect
from demorec.runs.run_file import sha256_of
from demorec.sources.channel import BagError
from demorec.sources.dataset_pictures import DatasetCamera, DepthCamera, ImageCamera, VideoCamera
from demorec.sources.frames_writer import FramesImport, write_frames
from demorec.sources.mapping_file import MAX_ELEMENTS

_SUCCESS = "next.success"
_TIME_TOLERANCE_S = 1e-4
"""By which LeRobot lets a row's time be off the grid."""
_UNNAMED_ROBOT = "unknown"
_RECORDED: Mapping[str, Literal["float32", "float64"]] = {
    **dict.fromkeys(("bool", "int8", "uint8", "int16", "uint16", "float16", "float32"), "float32"),
    **dict.fromkeys(("int32", "uint32", "int64", "uint64", "float64"), "float64"),
}
"""Type of a column -> the type that holds all its numbers, of the largest integers only those up to `_EXACT`."""
_EXACT = 2**53
"""Up to which float64 holds every whole number."""


def import_lerobot(root: Path, out: Path, *, video: VideoConfig | None = None) -> FramesImport:
    """Import a LeRobot v3.0 dataset, whoever wrote it, into a run.

    Args:
        root: The dataset's folder.
        out: The run's folder; one that the same dataset began is continued.
        video: How pictures are coded that cannot be kept.

    Raises:
        ConfigError: This is no dataset, it has what no recording can hold, or the folder holds something else.
        BagError, ExportError: It is damaged, or not at its rate.
        RecordingError: A number is not finite, or the disk is full.
    """
    expect(root, "dataset")
    dataset = _Dataset(root)
    num_new = num_frames = 0
    with open_external_run(out, recovers=False) as folder:
        for place in dataset.places:
            info, features, success = dataset.episode(place)
            num_frames += place.length
            if not folder.has(info):
                write_frames(
                    folder,
                    info,
                    ({name: rows[number] for name, rows in features.items()} for number in range(place.length)),
                    {name: camera.pictures(place) for name, camera in dataset.cameras.items()},
                    success=success,
                    video=video or VideoConfig(),
                    leads={name: camera.lead(place) for name, camera in dataset.cameras.items()},
                    subtasks=dataset.subtasks.get(place.episode_index),
                )
                num_new += 1
    return FramesImport(
        num_episodes=len(dataset.places),
        num_frames=num_frames,
        num_new=num_new,
        cameras={name: camera.told for name, camera in dataset.cameras.items()},
        left_out=dataset.left_out,
    )


class _Dataset:
    """A dataset opened for import; episodes must be asked for in their order."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.info = info = DatasetInfo.load(root)
        self.places = list(episode_places(root, info))
        if not self.places:
            raise ConfigError(f"The dataset has no episodes: {root}")
        if empty := [place.episode_index for place in self.places if place.length < 1]:
            raise BagError(f"Episode {empty[0]} of the dataset has no frames: {root}")
        self.features: list[Feature] = []
        self.cameras: dict[str, DatasetCamera] = {}
        self.left_out: dict[str, str] = {}
        for name, feature in info.features.items():
            if reason := _why_left_out(name, feature):
                self.left_out[name] = reason
            elif feature.dtype in ("video", "image"):
                # "top" for "observation.images.top", "image" for "observation.image".
                camera = name.removeprefix(IMAGE_PREFIX).removeprefix("observation.").replace(".", "_")
                if camera in self.cameras:
                    raise ConfigError(f"Two cameras of the dataset would be called {camera!r}: {root}")
                kind = DepthCamera if feature.is_depth else VideoCamera if feature.is_video else ImageCamera
                self.cameras[camera] = kind(root, info, name, self.places)
            elif feature.dtype in ("int64", "uint64") and name not in AUTOMATIC_FEATURES and not _is_exact(root, name):
                self.left_out[name] = "it has whole numbers that float64 cannot hold"
            elif name not in AUTOMATIC_FEATURES and name != _SUCCESS:
                self.features.append(_feature(name, feature))
        columns = [*(feature.name for feature in self.features), "timestamp", "task_index"]
        columns += [_SUCCESS] if _SUCCESS in info.features else []
        if missing := [name for name in columns if name not in info.features]:
            raise BagError(f"The dataset has no {', '.join(missing)}: {root}")
        spoken = {name for name, feature in info.features.items() if feature.dtype == "language"}
        self.subtasks = self._read_subtasks() if spoken >= set(COLUMNS) else {}
        self._tasks = read_tasks(root)
        self._reader = RowReader(root, replace(info, features={name: info.features[name] for name in columns}))
        self._digest = functools.cache(sha256_of)

    def episode(self, place: EpisodePlace) -> tuple[EpisodeInfo, dict[str, Vector], bool | None]:
        """What is known of an episode of T frames, its numbers (feature -> (T, D)), and how it ended."""
        columns = self._reader.read(place)
        number, fps = place.episode_index, int(self.info.fps)
        off = np.abs(columns["timestamp"][:, 0].astype(np.float64) - np.arange(place.length) / fps)
        if len(wrong := np.flatnonzero(~(off <= _TIME_TOLERANCE_S))):
            raise BagError(
                f"Row {wrong[0]} of episode {number} is at {columns['timestamp'][wrong[0], 0]:.4f} s, which is no "
                f"multiple of 1/{fps} s: {self.root}"
            )
        tasks = list(dict.fromkeys(columns["task_index"][:, 0].tolist()))
        if any(not 0 <= task < len(self._tasks) for task in tasks):
            raise BagError(f"Episode {number} names a task that is not in the table of tasks: {self.root}")
        info = EpisodeInfo(
            episode_index=number,
            instruction="; ".join(" ".join(self._tasks[task].split()) for task in tasks),
            robot=self.info.robot_type or _UNNAMED_ROBOT,
            fps=fps,
            features=tuple(self.features),
            cameras=tuple(
                Camera(name=name, width=camera.width, height=camera.height, kept=camera.kept, source=camera.key)
                for name, camera in self.cameras.items()
            ),
            origin=Origin(kind="import", files=tuple(self._files(place))),
            versions={"demorec": version("demorec"), "av": version("av")},
        )
        vectors: dict[str, Vector] = {}
        for feature in self.features:
            found, told = columns[feature.name], self.info.features[feature.name].dtype
            if found.dtype != told:
                raise BagError(f"The column {feature.name} holds {found.dtype}, not {told}: {self.root}")
            vectors[feature.name] = found.astype(feature.dtype)
        success = bool(columns[_SUCCESS][-1, 0]) if _SUCCESS in columns and place.length else None
        return info, vectors, success

    def _read_subtasks(self) -> dict[int, dict[int, str]]:
        """Episode -> frame -> what is begun there; what else is said is left out."""
        said: dict[int, dict[int, str]] = {}
        del self.left_out[PERSISTENT]
        for place, spoken in zip(self.places, spoken_episodes(self.root), strict=False):
            texts = said.setdefault(place.episode_index, {})
            if spoken.num_rows != place.length:
                raise BagError(f"Episode {place.episode_index} has other rows than its table says: {self.root}")
            for row in spoken.persistent:
                text, begin = str(row.get("content")), row.get("timestamp")
                frame = begin * self.info.fps if isinstance(begin, float) else -1
                if row.get("style") != "subtask" or not 0 <= frame < place.length:
                    self.left_out[PERSISTENT] = "all but its subtasks"
                elif len(text) > MAX_SUBTASK or not text.isprintable():
                    self.left_out[PERSISTENT] = f"a subtask is no single line of at most {MAX_SUBTASK} characters"
                    return {}
                else:
                    texts[round(frame)] = text
        return said

    def _files(self, place: EpisodePlace) -> Iterator[SourceFile]:
        """What an episode was read from, by its place in the dataset."""
        paths = [INFO_PATH, place.data.path(self.info.data_path)]
        paths += [
            place.videos[camera.key][0].path(self.info.video_path or "", camera.key)
            for camera in self.cameras.values()
            if camera.key in place.videos
        ]
        for name in paths:
            yield SourceFile(name=name, sha256=self._digest(self.root / name))


def _why_left_out(name: str, feature: DatasetFeature) -> str:
    """Why a feature is in no recording, "" for one that is."""
    if name in AUTOMATIC_FEATURES or name == _SUCCESS:
        return ""
    if name.startswith("next."):
        return "recordings of other robots have no place for it"
    if feature.is_depth:
        return _why_no_distances(feature)
    if feature.dtype not in ("video", "image", *_RECORDED):
        return f"it is {feature.dtype}, and recordings of other robots hold numbers"
    if feature.is_numeric and feature.dtype != "image" and feature.shape[0] > MAX_ELEMENTS:
        return f"it has {feature.shape[0]:,} numbers a row, and recordings of other robots hold up to {MAX_ELEMENTS:,}"
    if feature.is_numeric and feature.dtype != "image" and len(feature.shape) > 1:
        return f"it is an array of {'x'.join(map(str, feature.shape))}, and recordings of other robots hold vectors"
    return ""


def _why_no_distances(feature: DatasetFeature) -> str:
    """Why the distances of a depth feature cannot be read, "" when they can."""
    if not feature.is_video:
        return "its depth is in images, and depth is read from videos"
    try:
        DepthScale.of(feature.info or {})
    except ValueError as error:
        return str(error)
    return ""


def _feature(name: str, feature: DatasetFeature) -> Feature:
    count = int(np.prod(feature.shape))
    names = tuple(name.replace(",", " ") for name in feature.names or ())
    if len(names) != count or len(set(names)) != count or not all(text and text.isprintable() for text in names):
        names = tuple(str(number) for number in range(count))
    return Feature(name=name, dtype=_RECORDED[feature.dtype], names=names, source=name)


def _is_exact(root: Path, name: str) -> bool:
    """Whether float64 holds all whole numbers of a column; BagError when they cannot be read."""
    for path in sorted((root / "data").glob("*/*.parquet")):
        try:
            for batch in table_batches(path, [name], rows=4096):
                numbers = column_numbers(batch.column(name))
                if ((numbers > _EXACT) | (numbers < -_EXACT)).any():
                    return False
        except (OSError, ValueError, TypeError, pa.ArrowException) as error:
            raise BagError(f"The column {name} cannot be read ({in_words(error)}): {path}") from error
    return True
