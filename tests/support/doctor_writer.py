"""Write datasets in LeRobot's formats v2.1 and v3.0, with statistics in float32 as LeRobot computes them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from support import doctor_render
from support.doctor_bases import DemoDataset, DemoEpisode, Images

Statistics = dict[str, NDArray[Any]]
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_COUNTERS = {"timestamp": "float32", **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")}
EPISODES_PER_VIDEO = 4  # so that v3.0 has more than one video file


@dataclass(frozen=True)
class VideoStore:
    """Cache of encoded videos for datasets that share them: images of episodes -> file and statistics."""

    folder: Path
    found: dict[tuple[Images, ...], tuple[Path, list[Statistics]]] = field(default_factory=dict)

    def video(self, images: tuple[Images, ...], fps: int) -> tuple[Path, list[Statistics]]:
        """The video of some episodes, one after the other, and the statistics of each."""
        if images not in self.found:
            path = self.folder / f"{len(self.found)}.mp4"
            self.found[images] = (path, encode(path, images, fps))
        return self.found[images]


def encode(path: Path, images: Sequence[Images], fps: int) -> list[Statistics]:
    """Write an H.264 video and return the statistics of each episode."""
    found = []
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"preset": "ultrafast", "crf": "26", "g": "2"})
        stream.pix_fmt, stream.codec_context.thread_count = "yuv420p", 1
        for draw in images:
            drawn = draw()
            stream.height, stream.width = drawn.shape[1:3]
            for image in drawn:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            found.append(image_statistics(drawn))
        container.mux(stream.encode())
    return found


def image_statistics(images: NDArray[np.uint8]) -> Statistics:
    """Statistics of up to 100 images, 0 to 1, (3, 1, 1) each; sums are float32 like LeRobot's."""
    taken = images[np.round(np.linspace(0, len(images) - 1, min(100, len(images)))).astype(int)]
    found = {name: value / 255 for name, value in _moments(taken.reshape(-1, 3)).items()}
    for name, share in QUANTILES.items():
        found[name] = np.quantile(taken[::5, ::3, ::3].reshape(-1, 3), share, axis=0) / 255
    return {name: value.reshape(3, 1, 1) for name, value in found.items()} | {"count": np.array([len(taken)])}


def _moments(rows: NDArray[Any]) -> Statistics:
    """Minimum, maximum, mean and deviation of (N, D) rows, in the type with which LeRobot sums them."""
    rows = rows.astype(np.result_type(rows.dtype, np.float32), copy=False)
    mean = rows.mean(0)
    deviation = np.sqrt(np.maximum(0, (rows**2).mean(0) - mean**2))
    return {"min": rows.min(0), "max": rows.max(0), "mean": mean, "std": deviation}


def statistics(rows: NDArray[Any], version: str) -> Statistics:
    """Statistics of one episode's (T, D) rows; those of v2.1 are NumPy's and have no quantiles."""
    if version == "v2.1":
        found = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
        return {**found, "count": np.array([len(rows)])}
    found = _moments(rows)
    for name, share in QUANTILES.items():
        found[name] = np.array([_histogram_quantile(column, share) for column in rows.T])
    return {**found, "count": np.array([len(rows)])}


def _histogram_quantile(values: NDArray[Any], share: float) -> float:
    """A quantile from a histogram of 5,000 bins."""
    if not np.isfinite(values).all():
        return float("nan")
    counts, edges = np.histogram(values, bins=np.linspace(values.min() - 1e-10, values.max() + 1e-10, 5001))
    below = np.cumsum(counts)
    place = int(np.searchsorted(below, share * len(values)))
    if place in (0, len(counts)) or counts[place] == 0:
        return float(edges[place])
    return float(edges[place] + (share * len(values) - below[place - 1]) / counts[place] * (edges[1] - edges[0]))


def aggregate(each: Sequence[Statistics]) -> Statistics:
    """Statistics of a dataset from those of its episodes."""
    weights = np.array([one["count"][0] for one in each], float)
    weights = (weights / weights.sum()).reshape(-1, *[1] * each[0]["mean"].ndim)
    means = np.stack([one["mean"] for one in each])
    mean = (means * weights).sum(0)
    variance = ((np.stack([one["std"] ** 2 for one in each]) + (means - mean) ** 2) * weights).sum(0)
    found = {"min": np.min([one["min"] for one in each], axis=0), "max": np.max([one["max"] for one in each], axis=0)}
    found |= {"mean": mean, "std": np.sqrt(variance), "count": np.sum([one["count"] for one in each], axis=0)}
    return found | {
        name: (np.stack([one[name] for one in each]) * weights).sum(0) for name in QUANTILES if name in each[0]
    }


def write_dataset(dataset: DemoDataset, root: Path, store: VideoStore) -> Path:
    """Write a dataset into a new folder."""
    base, episodes = dataset.base, dataset.episodes
    tasks = list(dict.fromkeys(episode.task for episode in episodes))
    tables, begin = [], 0
    for number, episode in enumerate(episodes):
        tables.append(_rows(episode, number, begin, tasks.index(episode.task)))
        begin += len(tables[-1])
    stats = [{name: statistics(_array(table, name), base.version) for name in table.column_names} for table in tables]
    (root / "meta").mkdir(parents=True)
    places = _write_videos(dataset, root, store, stats)
    info = _info(dataset, len(tasks), begin)
    (root / "meta/info.json").write_text(json.dumps(info, indent=4))
    if base.version == "v2.1":
        _write_v21(dataset, root, tables, tasks, stats)
    else:
        _write_v30(dataset, root, tables, tasks, stats, places)
    return root


def _rows(episode: DemoEpisode, number: int, begin: int, task: int) -> pa.Table:
    length = len(episode.time_s)
    columns: dict[str, Any] = {
        name: pa.FixedSizeListArray.from_arrays(pa.array(values.astype(np.float32).reshape(-1)), values.shape[1])
        for name, values in episode.columns.items()
    }
    columns["timestamp"] = episode.time_s.astype(np.float32)
    columns["frame_index"] = np.arange(length)
    columns["episode_index"] = np.full(length, number)
    columns["index"] = begin + np.arange(length)
    columns["task_index"] = np.full(length, task)
    return pa.table(columns)


def _array(table: pa.Table, name: str) -> NDArray[Any]:
    column = table.column(name).combine_chunks()
    flat = column.flatten() if pa.types.is_fixed_size_list(column.type) else column
    return np.asarray(flat.to_numpy(zero_copy_only=False)).reshape(len(table), -1)


def _info(dataset: DemoDataset, tasks: int, frames: int) -> dict[str, Any]:
    base, first = dataset.base, dataset.episodes[0]
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(names)], "names": list(names)} for name, names in base.features.items()
    }
    height, width = doctor_render.HEIGHT, doctor_render.WIDTH
    for camera in first.images:
        info = {"video.height": height, "video.width": width, "video.codec": "h264", "video.pix_fmt": "yuv420p"}
        info |= {"video.is_depth_map": False, "video.fps": base.fps, "video.channels": 3, "has_audio": False}
        shape = {"shape": [height, width, 3], "names": ["height", "width", "channels"]}
        features[camera] = {"dtype": "video", **shape, "info": info}
    features |= {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _COUNTERS.items()}
    is_old = base.version == "v2.1"
    new_path = "chunk-{chunk_index:03d}/file-{file_index:03d}"
    video = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    count = len(dataset.episodes)
    return {
        "codebase_version": base.version, "robot_type": base.robot, "total_episodes": count, "total_frames": frames,
        "total_tasks": tasks, "chunks_size": 1000, "fps": base.fps, "splits": {"train": f"0:{count}"},
        **({"total_videos": count * len(first.images), "total_chunks": 1} if is_old
           else {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200}),
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet" if is_old
        else f"data/{new_path}.parquet",
        "video_path": None if not first.images else video if is_old else f"videos/{{video_key}}/{new_path}.mp4",
        "features": features,
    }  # fmt: skip


def _write_videos(
    dataset: DemoDataset, root: Path, store: VideoStore, stats: list[dict[str, Statistics]]
) -> list[dict[str, Any]]:
    """Copy the videos, add the statistics of images, and return the position of each episode in v3.0's files."""
    base, episodes = dataset.base, dataset.episodes
    is_old = base.version == "v2.1"
    places: list[dict[str, Any]] = [{} for _ in episodes]
    for camera in episodes[0].images:
        for file, first in enumerate(range(0, len(episodes), 1 if is_old else EPISODES_PER_VIDEO)):
            group = range(first, min(len(episodes), first + (1 if is_old else EPISODES_PER_VIDEO)))
            source, found = store.video(tuple(episodes[number].images[camera] for number in group), base.fps)
            name = f"chunk-000/{camera}/episode_{file:06d}" if is_old else f"{camera}/chunk-000/file-{file:03d}"
            (root / f"videos/{name}.mp4").parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, root / f"videos/{name}.mp4")
            begin = 0.0
            for number, image in zip(group, found, strict=True):
                stats[number][camera] = image
                end = begin + len(episodes[number].time_s) / base.fps
                values = {"chunk_index": 0, "file_index": file, "from_timestamp": begin, "to_timestamp": end}
                places[number] |= {f"videos/{camera}/{key}": value for key, value in values.items()}
                begin = end
    return places


def _lists(each: dict[str, Statistics]) -> dict[str, Any]:
    return {feature: {name: value.tolist() for name, value in values.items()} for feature, values in each.items()}


def _write_v21(
    dataset: DemoDataset, root: Path, tables: list[pa.Table], tasks: list[str], stats: list[dict[str, Statistics]]
) -> None:
    (root / "data/chunk-000").mkdir(parents=True)
    for number, table in enumerate(tables):
        pq.write_table(table, root / f"data/chunk-000/episode_{number:06d}.parquet")
    episodes = [
        {"episode_index": number, "tasks": [episode.task], "length": len(episode.time_s)}
        for number, episode in enumerate(dataset.episodes)
    ]
    lines = {
        "episodes": episodes,
        "tasks": [{"task_index": number, "task": task} for number, task in enumerate(tasks)],
        "episodes_stats": [{"episode_index": number, "stats": _lists(each)} for number, each in enumerate(stats)],
    }
    for name, rows in lines.items():
        (root / f"meta/{name}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def _write_v30(
    dataset: DemoDataset, root: Path, tables: list[pa.Table], tasks: list[str], stats: list[dict[str, Statistics]],
    places: list[dict[str, Any]],
) -> None:  # fmt: skip
    (root / "data/chunk-000").mkdir(parents=True)
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    with pq.ParquetWriter(root / "data/chunk-000/file-000.parquet", tables[0].schema) as writer:
        for table in tables:
            writer.write_table(table)
    rows, begin = [], 0
    for number, (episode, place, each) in enumerate(zip(dataset.episodes, places, stats, strict=True)):
        length = len(episode.time_s)
        row = {"episode_index": number, "tasks": [episode.task], "length": length}
        row |= {
            "data/chunk_index": 0,
            "data/file_index": 0,
            "dataset_from_index": begin,
            "dataset_to_index": begin + length,
        }
        flat = {
            f"stats/{feature}/{name}": value.tolist()
            for feature, values in each.items()
            for name, value in values.items()
        }
        rows.append({**row, **place, **flat, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
        begin += length
    pq.write_table(pa.Table.from_pylist(rows), root / "meta/episodes/chunk-000/file-000.parquet")
    frame = pd.DataFrame({"task_index": range(len(tasks))}, index=pd.Index(tasks, name="task"))
    frame.to_parquet(root / "meta/tasks.parquet")
    whole = {feature: aggregate([each[feature] for each in stats]) for feature in stats[0]}
    (root / "meta/stats.json").write_text(json.dumps(_lists(whole), indent=4))
