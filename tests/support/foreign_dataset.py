"""A LeRobot v3.0 dataset as another program may write it, by PyArrow and JSON alone, with images in its rows."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from PIL import Image

from support.drawn_datasets import write_tables

DATA, TASKS = "data/chunk-000/file-000.parquet", "meta/tasks.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
COUNTERS = {"timestamp": "float32", **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")}


def counters(length: int, episodes: int, fps: int) -> dict[str, Any]:
    """Columns that count the rows of episodes of the same length, all of task 0."""
    frames = np.tile(np.arange(length), episodes)
    return {
        "timestamp": (frames / fps).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.repeat(np.arange(episodes), length),
        "index": np.arange(len(frames)),
        "task_index": np.zeros(len(frames), np.int64),
    }


def write_foreign(
    root: Path,
    *,
    length: int = 8,
    episodes: int = 2,
    size: tuple[int, int] = (64, 48),
    state: Mapping[str, Sequence[float]] | None = None,
) -> Path:
    """Write episodes of `length` rows at 10 Hz, with a state, an action and a camera of `size` (width, height).

    The values of the state are those of `state` for each element and row, by default noise.
    """
    rows, names = length * episodes, list(state or "abc")
    width = len(names)
    shapes: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": [width], "names": names},
        "action": {"dtype": "float32", "shape": [width], "names": None},
        "observation.images.top": {"dtype": "image", "shape": [size[1], size[0], 3], "names": None},
        **{name: {"dtype": kind, "shape": [1], "names": None} for name, kind in COUNTERS.items()},
    }
    shown = io.BytesIO()
    Image.new("RGB", size).save(shown, "PNG")
    noise = np.random.default_rng(0).normal(size=(rows, width))
    told = noise if state is None else np.column_stack(list(state.values()))
    numbers = pa.array(told.astype(np.float32).reshape(-1))
    kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    columns: dict[str, Any] = {
        "observation.state": pa.FixedSizeListArray.from_arrays(numbers, width),
        "action": pa.FixedSizeListArray.from_arrays(numbers, width),
        "observation.images.top": pa.array([{"bytes": shown.getvalue(), "path": None}] * rows, kind),
        **counters(length, episodes, 10),
    }
    info = {"codebase_version": "v3.0", "fps": 10, "robot_type": "so100", "features": shapes}
    table = pa.table(columns)
    write_tables(root, info, [table.slice(length * number, length) for number in range(episodes)], ["push it"])
    (root / "meta/stats.json").write_text("{}")
    return root
