"""Write a LeRobot v3.0 dataset episode by episode, at the same cost for the first and the ten-thousandth.

Written files are neither read nor rewritten while episodes are added; tables roll over by size, each kind separately;
an episode never spans two files. The format's rules come from LeRobot's own reader and writer.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from demorec.core.errors import ExportError, describe_error
from demorec.core.files import Closing
from demorec.datasets.lerobot.files import column_values, tables_in, write_text
from demorec.datasets.lerobot.language import REPEATING, column_digests, is_language
from demorec.datasets.lerobot.layout import (
    AUTOMATIC_FEATURES,
    DATA_PATH,
    EPISODES_PATH,
    MEBIBYTE,
    STATS_PATH,
    TASKS_PATH,
    VIDEO_PATH,
    DatasetInfo,
    data_schema,
    episode_digest,
    merged_video_info,
)
from demorec.datasets.lerobot.mp4 import EncodedVideo, Mp4Writer
from demorec.datasets.lerobot.parquet import RollingParquet, next_position, vector_array
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.datasets.lerobot.sidecar import EpisodeRecord, SidecarWriter
from demorec.datasets.lerobot.stats import (
    NAMES,
    PixelHistogram,
    Statistics,
    data_statistics,
    merge_statistics,
    vector_statistics,
)

_MAX_SECONDS_PER_VIDEO = 900.0
"""LeRobot compares timestamps as float32, whose step is 6e-5 s beyond 512 s and 1.2e-4 s beyond 1024 s, with a
tolerance of 1e-4 s: a new mp4 file begins before that, unless a single episode is longer.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeData:
    """One episode, ready to be written.

    Attributes:
        task: Instruction.
        columns: Feature -> (T,) or (T, D), or an Arrow column of T values, which is written unchanged; without videos
        and the automatic features.
        videos: Camera feature -> encoded images, T of them.
        video_info: Camera feature -> its encoding, the feature's `info`.
        pixels: Camera feature -> histogram for the statistics, or the statistics if the images were not decoded.
        facts: Column of the table of episodes -> value; written if the dataset has the column.
        row_tasks: Instruction of each row, if there are several; `task` is the first.
        annotated_tasks: Tasks of annotation columns, which the table of episodes also lists.
        timestamps: (T,) float32 or float64 seconds; None for multiples of 1/fps.
        record: Its data for the sidecar; None in a dataset without one.
    """

    task: str
    columns: Mapping[str, NDArray[Any] | pa.Array]
    videos: Mapping[str, EncodedVideo] = field(default_factory=dict)
    video_info: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    pixels: Mapping[str, PixelHistogram | Statistics] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    row_tasks: Sequence[str] = ()
    annotated_tasks: Sequence[str] = ()
    timestamps: NDArray[Any] | None = None
    record: EpisodeRecord | None = None

    @property
    def num_frames(self) -> int:
        """T."""
        return len(next(iter(self.columns.values())))


@dataclass(frozen=True, kw_only=True, eq=False)
class DatasetStart:
    """A dataset before the first new episode.

    Attributes:
        info: Features, limits, and the numbers of existing episodes and frames.
        facts: Columns of the table of episodes beyond LeRobot's own -> type.
        tasks: Existing instructions in the order of their indices.
        statistics: Statistics of the camera features over the existing episodes.
        configs: Config digest -> configuration, of the existing episodes; None for a dataset without a sidecar.
        digests: Content digests of the existing episodes, in order.
    """

    info: DatasetInfo
    facts: Mapping[str, pa.DataType] = field(default_factory=dict)
    tasks: Sequence[str] = ()
    statistics: Mapping[str, Statistics] = field(default_factory=dict)
    configs: Mapping[str, Any] | None = None
    digests: Sequence[str] = ()


class DatasetWriter(Closing):
    """Context manager; `finish` completes the metadata.

    Args:
        root: Folder of the dataset, which already holds the existing files.
        start: State before the first new episode.
    """

    def __init__(self, root: Path, start: DatasetStart) -> None:
        self._root = root
        self._info = info = start.info
        self._facts = dict(start.facts)
        self._old_statistics = start.statistics
        self._schema = data_schema(info.features)
        self._numeric = [name for name in self._schema.names if info.features[name].is_numeric]
        arrays = [name for name in self._numeric if len(info.features[name].shape) > 1]
        self._arrays = {name: info.features[name].shape[-1] for name in arrays}
        self._tasks = {task: index for index, task in enumerate(start.tasks)}
        self.num_episodes = info.total_episodes
        self.num_frames = info.total_frames
        strings = [name for name in self._schema.names if info.features[name].dtype == "string"]
        has_language = any(feature.dtype == "language" for feature in info.features.values())
        self._cameras = [name for name, feature in info.features.items() if feature.is_camera]
        self._data = RollingParquet(
            root,
            DATA_PATH,
            self._schema,
            info,
            repeating=["episode_index", "task_index", *strings, *(REPEATING if has_language else ())],
        )
        self._episodes = RollingParquet(root, EPISODES_PATH, self._episode_schema(), info)
        self._videos: dict[str, Mp4Writer] = {}
        self._video_positions = {key: next_position(root / "videos" / key, info.chunks_size) for key in info.video_keys}
        self._video_info = {key: info.features[key].info for key in info.video_keys}
        self._pixels: dict[str, PixelHistogram] = {}
        self._unseen: dict[str, Statistics] = {}  # of images without histograms
        self._sidecar = None if start.configs is None else SidecarWriter(root, info, start.configs)

    def close(self) -> None:
        """Release the files; unfinished ones are dropped, or left in place."""
        if self._sidecar is not None:
            self._sidecar.close()
        for video in self._videos.values():
            video.abort()
        self._data.abort()
        self._episodes.abort()

    def add(self, episode: EpisodeData) -> str:
        """Append an episode; return its digest (`demorec.datasets.lerobot.layout`), "" if its images are in rows or its
        videos have no digest.
        """
        frames = episode.num_frames
        if frames == 0:
            raise ExportError("An episode without frames cannot be exported.")
        tasks = dict.fromkeys(episode.row_tasks or [episode.task])
        task_indices = {task: self._tasks.setdefault(task, len(self._tasks)) for task in tasks}
        task_index = np.array([task_indices[task] for task in episode.row_tasks or [episode.task] * frames])
        columns = {
            **{name: episode.columns[name] for name in self._schema.names if name not in AUTOMATIC_FEATURES},
            "timestamp": (
                (np.arange(frames) / self._info.fps).astype(self._info.features["timestamp"].dtype)
                if episode.timestamps is None
                else episode.timestamps
            ),
            "frame_index": np.arange(frames),
            "episode_index": np.full(frames, self.num_episodes),
            "index": np.arange(self.num_frames, self.num_frames + frames),
            "task_index": task_index,
        }
        position = self._data.make_room(frames)
        self._write_rows(columns)
        row: dict[str, Any] = {
            "episode_index": self.num_episodes,
            "tasks": list(dict.fromkeys([*tasks, *episode.annotated_tasks])),
            "length": frames,
            "data/chunk_index": position.chunk,
            "data/file_index": position.file,
            "dataset_from_index": self.num_frames,
            "dataset_to_index": self.num_frames + frames,
            **{name: episode.facts.get(name) for name in self._facts},
        }
        values = {name: values_of(columns[name]) for name in self._numeric}
        digests = {}
        for key in self._info.video_keys:
            row.update(self._add_video(key, episode.videos[key], frames))
            digests[key] = episode.videos[key].digest
            self._video_info[key] = merged_video_info(self._video_info[key] or {}, dict(episode.video_info[key]))
        statistics = self._number_statistics(values, frames)
        statistics |= {key: self._count(key, episode.pixels[key]) for key in self._cameras}
        row |= {f"stats/{key}/{name}": found.nested(name) for key, found in statistics.items() for name in NAMES}
        self._episodes.add_row(row)
        digest = ""
        if len(digests) == len(self._cameras) and all(digests.values()):
            values |= {name: values_of(column) for name, column in columns.items() if name not in values}
            digest = episode_digest(episode.task, values, digests)
        if self._sidecar is not None and episode.record is not None:
            self._sidecar.add(self.num_episodes, digest, episode.record)
        self.num_frames += frames
        self.num_episodes += 1
        return digest

    def _write_rows(self, columns: Mapping[str, NDArray[Any] | pa.Array]) -> None:
        arrays = []
        for item in self._schema:
            try:
                arrays.append(vector_array(columns[item.name], item.type))
            except pa.ArrowException as error:
                raise ExportError(
                    f"The column {item.name} of the new episode {self.num_episodes} does not match {INFO_PATH} "
                    f"({describe_error(error)})."
                ) from error
        self._data.write(pa.Table.from_arrays(arrays, schema=self._schema))

    def _number_statistics(self, values: Mapping[str, NDArray[Any]], frames: int) -> dict[str, Statistics]:
        statistics = vector_statistics({name: values[name] for name in self._numeric if name not in self._arrays})
        for name, width in self._arrays.items():
            vectors = vector_statistics({name: values[name].reshape(-1, width)})[name]
            statistics[name] = replace(vectors, count=frames)
        return statistics

    def _count(self, key: str, pixels: PixelHistogram | Statistics) -> Statistics:
        if isinstance(pixels, Statistics):
            before = self._unseen.get(key)
            self._unseen[key] = pixels if before is None else merge_statistics([before, pixels])
            return pixels
        self._pixels[key] = self._pixels[key] + pixels if key in self._pixels else pixels
        return pixels.statistics()

    def _add_video(self, key: str, video: EncodedVideo, frames: int) -> dict[str, int | float]:
        if video.num_frames != frames:
            raise ExportError(f"{key} has {video.num_frames} images for {frames} frames.")
        file = self._videos.get(key)
        fps = self._info.fps
        if file is not None and (
            file.num_bytes + video.num_bytes >= self._info.video_files_size_in_mb * MEBIBYTE
            or (file.num_images + len(video.sizes)) / fps > _MAX_SECONDS_PER_VIDEO
            or file.parameter_sets != video.parameter_sets()
            or file.delay < video.delay
        ):
            file.close()
            file = None
            self._video_positions[key] = self._video_positions[key].next(self._info.chunks_size)
        position = self._video_positions[key]
        if file is None:
            path = self._root / position.path(VIDEO_PATH, key)
            file = self._videos[key] = Mp4Writer(path, video, fps=fps)
        start = file.num_images + video.lead
        file.add(video)
        return {
            f"videos/{key}/chunk_index": position.chunk,
            f"videos/{key}/file_index": position.file,
            f"videos/{key}/from_timestamp": start / fps,
            f"videos/{key}/to_timestamp": (start + frames) / fps,
        }

    def finish(self, export: Mapping[str, Any]) -> DatasetInfo:
        """Close all files, write tasks, statistics and info.json; return the content of info.json. `export` goes to the
        sidecar.
        """
        for video in self._videos.values():
            video.close()
        self._data.close()
        self._episodes.close()
        write_tasks(self._root / TASKS_PATH, list(self._tasks))
        statistics = data_statistics(tables_in(self._root, "data"), self._info.features)
        for key in self._cameras:
            new = self._pixels[key].statistics() if key in self._pixels else None
            found = (self._old_statistics.get(key), new, self._unseen.get(key))
            if parts := [part for part in found if part is not None]:
                statistics[key] = merge_statistics(parts)
        ordered = {name: statistics[name].to_json() for name in self._info.features if name in statistics}
        write_text(self._root / STATS_PATH, json.dumps(ordered, indent=4) + "\n")
        coded = {key: replace(self._info.features[key], info=found) for key, found in self._video_info.items()}
        info = replace(
            self._info,
            features={**self._info.features, **coded},
            total_episodes=self.num_episodes,
            total_frames=self.num_frames,
            total_tasks=len(self._tasks),
        )
        write_text(self._root / INFO_PATH, info.to_json())
        if self._sidecar is not None:
            self._sidecar.finish(export)
        return info

    def _episode_schema(self) -> pa.Schema:
        integers = ("data/chunk_index", "data/file_index", "dataset_from_index", "dataset_to_index")
        fields = [("episode_index", pa.int64()), ("tasks", pa.list_(pa.string())), ("length", pa.int64())]
        fields += [(name, pa.int64()) for name in integers]
        for key in self._info.video_keys:
            fields += [(f"videos/{key}/{name}", pa.int64()) for name in ("chunk_index", "file_index")]
            fields += [(f"videos/{key}/{name}", pa.float64()) for name in ("from_timestamp", "to_timestamp")]
        for key in (*self._numeric, *self._cameras):
            number = pa.list_(pa.float64())
            if key in self._cameras:
                number = pa.list_(pa.list_(number))
            fields += [(f"stats/{key}/{name}", pa.list_(pa.int64()) if name == "count" else number) for name in NAMES]
        fields += list(self._facts.items())
        fields += [("meta/episodes/chunk_index", pa.int64()), ("meta/episodes/file_index", pa.int64())]
        return pa.schema(fields)


def values_of(column: NDArray[Any] | pa.Array) -> NDArray[Any]:
    """Numbers or texts of a column, or digests of a language column."""
    if not isinstance(column, pa.Array):
        return column
    return column_digests(column) if is_language(column.type) else column_values(column)


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write tasks.parquet: LeRobot looks up tasks in the index of the data frame that pandas reads from it."""
    column = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    number = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
    index = {"name": None, "field_name": None, **column, "metadata": {"encoding": "UTF-8"}}
    description = {
        "index_columns": ["task"],
        "column_indexes": [index],
        "columns": [
            {"name": "task_index", "field_name": "task_index", **number},
            {"name": "task", "field_name": "task", **column},
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.3",
    }
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(description)}), path)
