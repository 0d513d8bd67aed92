"""A faster `LeRobotDataset`: it makes the items of a whole batch at once.

The items are those of LeRobot's reader, key for key and bit-exact.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from operator import index as as_index
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import DEPTH_METER_UNIT
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.depth_utils import MM_PER_METRE, dequantize_depth
from numpy.typing import NDArray

from lerobot_policy_act_keypoints.columns import Column, Statements, is_statements, numbers
from lerobot_policy_act_keypoints.errors import RequestError
from lerobot_policy_act_keypoints.images import ImageReader

INTERVENTION = "intervention"
"""Column of LeRobot's DAgger: true where the expert acts in an episode that a policy began."""
STRETCH_COLUMNS = ("index", "episode_index", INTERVENTION)


def expert_acts(episode: NDArray[Any], intervention: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether the expert acts in each frame, (N,): also in all frames of episodes without corrections.

    Args:
        episode: (N,) number of each frame's episode.
        intervention: (N,) or (N, 1) whether the expert acts after it took over from a policy.
    """
    acts = intervention.reshape(-1).astype(bool)
    return np.asarray(acts | ~np.isin(episode, episode[acts]))


class Stretches:
    """The stretches of frames in which the expert acts; an episode without corrections is one stretch.

    Args:
        index: (N,) index of each row of the table in the whole dataset.
        episode_index: (N,) episode of each row.
        intervention: (N,) whether the expert acts in it after it took over from a policy.

    Attributes:
        shown: (N,) row that replaces each row: itself where the expert acts; rows of the policy are replaced by rows of
            the expert, all equally often.
        first, end: (N,) index of the first frame of a row's stretch, and the one after its last.
    """

    def __init__(self, *, index: NDArray[Any], episode_index: NDArray[Any], intervention: NDArray[Any]) -> None:
        episode, index = episode_index.reshape(-1), index.reshape(-1)
        is_expert = expert_acts(episode, intervention)
        expert, others = np.flatnonzero(is_expert), np.flatnonzero(~is_expert)
        self.shown = np.arange(len(index))
        self.shown[others] = expert[np.arange(len(others)) * len(expert) // max(1, len(others))]
        begins = np.diff(episode, prepend=-1) != 0
        begins[1:] |= is_expert[1:] != is_expert[:-1]
        starts = np.flatnonzero(begins)
        number = np.cumsum(begins) - 1
        ends = np.append(starts[1:], len(index))
        self.first, self.end = index[starts][number], (index[ends - 1] + 1)[number]


Rows = NDArray[np.int64]
Item = dict[str, Any]


class FastReader(DatasetReader):  # type: ignore[misc]
    """Reader of whole batches.

    Args:
        reader: LeRobot's reader, which provides settings and table.
        cache_bytes: Maximum size of the decoded frames that each process keeps.
        expert_only: See `FastDataset`.
    """

    def __init__(self, reader: DatasetReader, cache_bytes: int, *, expert_only: bool = False) -> None:
        self.__dict__.update(vars(reader))
        self._cache_bytes = cache_bytes
        self._expert_only = expert_only
        self._tables: _Tables | None = None
        self._images: ImageReader | None = None
        self._process = 0
        self.left_out: NDArray[np.bool_] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Settings and LeRobot's table; a worker process makes its own arrays and opens its own files."""
        return {**self.__dict__, "_tables": None, "_images": None}

    def get_item(self, idx: int) -> Item:
        """Get one item. Raises IndexError for an index beyond the table."""
        return self.get_items([idx])[0]

    def get_items(self, indices: Sequence[int]) -> list[Item]:
        """Get the items of a batch, in the given order.

        Args:
            indices: Rows of the table (of the chosen episodes), negative ones counted from its end.

        Raises:
            IndexError: An index is beyond the table.
            FrameTimestampError: A video has no frame at the time of a row.
        """
        tables = self._current_tables()
        rows = np.array([_row(index, len(self.hf_dataset)) for index in indices], np.int64)
        if tables.stretches is not None:
            rows = tables.stretches.shown[rows]
        episodes, absolute = (tables.numbers[name].take(rows) for name in ("episode_index", "index"))
        windows: dict[str, Rows] = {}
        padding: dict[str, Sequence[torch.Tensor]] = {}
        for key, deltas in (self.delta_indices or {}).items():
            windows[key], is_pad = tables.window(rows, absolute, episodes, deltas)
            padding[f"{key}_is_pad"] = torch.from_numpy(is_pad).unbind(0)
        values = {name: self._values(tables, name, windows.get(name, rows)) for name in tables.names}
        for key in windows.keys() - values.keys() - set(self._meta.video_keys):
            raise KeyError(key)
        values |= padding
        if self._meta.video_keys:
            is_wanted = np.ones(len(rows), np.bool_) if self.left_out is None else ~self.left_out[absolute]
            values = self._videos(tables, episodes, values["timestamp"], windows, is_wanted) | values
        items = [dict(zip(values, item, strict=True)) for item in zip(*values.values(), strict=True)]
        depth_keys = self._meta.depth_keys
        colors = [key for key in self._meta.camera_keys if key not in depth_keys]
        for item in items:
            self._finish(item, colors, tables.tasks)
        return items

    def _current_tables(self) -> _Tables:
        if self._tables is None or self._tables.source is not self.hf_dataset:
            self._tables = _Tables(self)
        return self._tables

    def _current_images(self) -> ImageReader:
        """The image reader of this process: a forked process must not share file positions with its parent."""
        if self._images is None or self._process != os.getpid():
            self._images = ImageReader(self._video_backend, self._tolerance_s, self._cache_bytes)
            self._process = os.getpid()
        return self._images

    def _values(self, tables: _Tables, name: str, rows: Rows) -> Sequence[Any]:
        """Values of a feature for each item: of its row (B,), or stacked from the rows of its window (B, T)."""
        if name in tables.numbers:
            return list(tables.numbers[name].tensor(rows).unbind(0))
        if name in tables.statements and rows.ndim == 1:
            return tables.statements[name].take(rows)
        once, places = np.unique(rows, return_inverse=True) if rows.ndim > 1 else (rows, None)
        values: list[Any] = tables.others[name][once.tolist()][name]
        if places is None:
            return values
        return [torch.stack([values[place] for place in item]) for item in places.reshape(rows.shape)]

    def _videos(
        self,
        tables: _Tables,
        episodes: Rows,
        times: Sequence[torch.Tensor],
        windows: dict[str, Rows],
        is_wanted: NDArray[np.bool_],
    ) -> dict[str, list[torch.Tensor]]:
        """Video feature -> images of each item, (C, H, W) or (T, C, H, W); black ones for items that are not wanted."""
        now_s = np.array([time.item() for time in times], np.float64)[:, None]
        videos: dict[str, list[torch.Tensor]] = {}
        for key in self._meta.video_keys:
            times_s = tables.numbers["timestamp"].tensor(windows[key]).double().numpy() if key in windows else now_s
            times_s = times_s + tables.video_start_s[key][episodes][:, None]
            files = tables.video_file[key][episodes]
            found: list[Any] = [None] * len(episodes)
            is_depth = key in self._meta.depth_keys
            for file in np.unique(files[is_wanted]):
                places = np.flatnonzero((files == file) & is_wanted)
                path = tables.video_paths[key][file]
                images = self._current_images().read(path, times_s[places], is_depth=is_depth)
                for place, image in zip(places, images, strict=True):
                    found[place] = (self._depth(key, image) if is_depth else self._color(image)).squeeze(0)
            if not is_wanted.all():
                height, width, channels = self._meta.features[key]["shape"]
                black = torch.zeros(channels, height, width, dtype=torch.uint8 if self._return_uint8 else torch.float32)
                found = [black if image is None else image for image in found]
            videos[key] = found
        return videos

    def _color(self, images: torch.Tensor) -> torch.Tensor:
        """Convert to float32 in 0..1, unless uint8 is wanted."""
        return images if self._return_uint8 else images.to(torch.float32) / 255

    def _depth(self, key: str, codes: torch.Tensor) -> torch.Tensor:
        """Convert codes to distances in the wanted unit, float32."""
        coder = self._depth_encoder_configs[key]
        depth: torch.Tensor = dequantize_depth(
            codes,
            depth_min=coder.depth_min,
            depth_max=coder.depth_max,
            shift=coder.shift,
            use_log=coder.use_log,
            output_unit=self._depth_output_unit,
        )
        return depth

    def _finish(self, item: Item, colors: Iterable[str], tasks: Sequence[str]) -> None:
        """Apply image transforms (which may draw random numbers) and units to one item, and add its task."""
        if self._image_transforms is not None:
            for key in colors:
                item[key] = self._image_transforms(item[key])
        for key, unit in self._image_depth_units.items():
            if unit not in (None, self._depth_output_unit):
                item[key] = item[key] * MM_PER_METRE if unit == DEPTH_METER_UNIT else item[key] / MM_PER_METRE
        item["task"] = tasks[item["task_index"].item()]


class _Tables:
    """Tables of a dataset, ready for batches.

    Attributes:
        source: Table of rows that they were made from.
        names: Columns in order.
        numbers: Columns that are arrays.
        others: Other columns (images, texts, gaps), each as a table to which LeRobot's conversion is applied.
        statements: Language columns among `others`.
        video_paths: Video feature -> its files.
        video_file: Video feature -> number of the file of each episode, (E,).
        video_start_s: Video feature -> start of each episode in its file, in seconds, (E,) float64.
        tasks: Instructions by task index.
        stretches: Stretches in which the expert acts, if only these count.
    """

    def __init__(self, reader: FastReader) -> None:
        meta, self.source = reader._meta, reader.hf_dataset
        self.names = self.source.column_names
        columns = _columns(self.source, self.names)
        found = {name: numbers(column) for name, column in columns.items()}
        self.numbers: dict[str, Column] = {name: column for name, column in found.items() if column is not None}
        self.others = {name: self.source.select_columns([name]) for name in self.names if name not in self.numbers}
        self.statements = {
            name: Statements(table) for name, table in self.others.items() if is_statements(columns[name])
        }
        self.tasks = meta.tasks.index.tolist()
        episodes = _columns(meta.episodes, meta.episodes.column_names)
        self._starts, self._ends = (_array(episodes[f"dataset_{end}_index"]) for end in ("from", "to"))
        self.stretches = None
        if reader._expert_only:
            of_row = {name: self.numbers[name].take(np.arange(len(self.source))) for name in STRETCH_COLUMNS}
            self.stretches = Stretches(**of_row)
        self._row_of: Rows | None = None
        if reader._absolute_to_relative_idx is not None:
            absolute = self.numbers["index"].take(np.arange(len(self.source)))
            self._row_of = np.full(int(self._ends.max()), -1)
            self._row_of[absolute] = np.arange(len(absolute))
        self.video_paths: dict[str, list[Path]] = {}
        self.video_file: dict[str, Rows] = {}
        self.video_start_s: dict[str, NDArray[np.float64]] = {}
        for key in meta.video_keys:
            places = np.stack([_array(episodes[f"videos/{key}/{name}_index"]) for name in ("chunk", "file")], axis=1)
            _, first, self.video_file[key] = np.unique(places, axis=0, return_index=True, return_inverse=True)
            self.video_paths[key] = [reader.root / meta.get_video_file_path(int(episode), key) for episode in first]
            self.video_start_s[key] = _array(episodes[f"videos/{key}/from_timestamp"]).astype(np.float64)

    def window(
        self, rows_now: Rows, absolute: Rows, episodes: Rows, deltas: Iterable[int]
    ) -> tuple[Rows, NDArray[np.bool_]]:
        """Rows of the windows of a batch (B, T), clipped to their episodes (or to the expert's stretches), and whether
        each was clipped.

        Raises:
            KeyError: A chosen episode lacks rows in the table.
        """
        wanted = absolute[:, None] + np.array(list(deltas), np.int64)
        first, end = self._starts[episodes][:, None], self._ends[episodes][:, None]
        if self.stretches is not None:
            first, end = self.stretches.first[rows_now][:, None], self.stretches.end[rows_now][:, None]
        rows = np.clip(wanted, first, end - 1)
        is_beyond = (wanted < first) | (wanted >= end)
        if self._row_of is None:  # the table has all episodes, so row and index are equal
            return rows, is_beyond
        found = self._row_of[rows]
        if (found < 0).any():
            raise KeyError(int(rows[found < 0][0]))
        return found, is_beyond


def _columns(table: Any, names: Iterable[str]) -> dict[str, Any]:
    """Columns of a table of the package datasets, without copying."""
    arrow = table.with_format("arrow")[:]
    return {name: arrow.column(name) for name in names}


def _array(column: Any) -> NDArray[Any]:
    values: NDArray[Any] = column.to_numpy()
    return values


def _row(index: int, length: int) -> int:
    row = as_index(index)
    if not -length <= row < length:
        raise IndexError(f"Index {row} is beyond the {length} frames of the dataset.")
    return row % length


DEFAULT_CACHE_BYTES = 256 << 20


class FastDataset(LeRobotDataset):  # type: ignore[misc]
    """`LeRobotDataset` with another reader: equal items in the same order, several times as fast.

    A `DataLoader` requests whole batches from it; their rows are taken at once and their video frames decoded in file
    order. It can be pickled and forked; each process opens its own files and has its own cache.

    Args:
        *args: Arguments of `LeRobotDataset`.
        frame_cache_bytes: Maximum size of the decoded frames that each process keeps for later batches; 0 for none.
        expert_only: In episodes that an expert corrected (column `intervention`), learn from the expert alone: a frame
            of the policy is replaced by a frame of the expert, all equally often, and windows of actions end where
            frames of the policy begin.
        **kwargs: Arguments of `LeRobotDataset`.

    Raises:
        RequestError: `expert_only` is set, and the dataset has no column `intervention`.
    """

    _frame_cache_bytes = DEFAULT_CACHE_BYTES
    _expert_only = False

    def __init__(
        self, *args: Any, frame_cache_bytes: int = DEFAULT_CACHE_BYTES, expert_only: bool = False, **kwargs: Any
    ) -> None:
        self._frame_cache_bytes = frame_cache_bytes  # before the reader is made
        self._expert_only = expert_only
        super().__init__(*args, **kwargs)
        if expert_only and INTERVENTION not in self.meta.features:
            raise RequestError(
                f"The dataset does not state which frames are the expert's: export it with --intervention: {self.root}"
            )

    def __getitems__(self, indices: Sequence[int]) -> list[Item]:
        """Get the items of a batch, in the given order. `DataLoader` calls this."""
        if self.writer is not None and not self._is_finalized:
            return [self[index] for index in indices]  # LeRobot raises its own error
        reader = self._ensure_reader()
        if reader.hf_dataset is None:
            reader.load_and_activate()
        return reader.get_items(indices)

    def leave_out_images(self, left_out: NDArray[np.bool_]) -> None:
        """Return black images for the marked frames from now on.

        Args:
            left_out: (total_frames,) by the dataset's index; later changes of the array have an effect.
        """
        self._ensure_reader().left_out = left_out

    def _ensure_reader(self) -> FastReader:
        reader = super()._ensure_reader()
        if not isinstance(reader, FastReader):
            reader = FastReader(reader, self._frame_cache_bytes, expert_only=self._expert_only)
            self.reader = reader
        return reader
