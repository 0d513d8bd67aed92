"""Random LeRobot datasets as other programs write them, by PyArrow, libav and JSON alone."""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from av.video.stream import VideoStream
from hypothesis import strategies as st
from PIL import Image

STATE, ACTION, TOP = "observation.state", "action", "observation.images.top"
REFERENCE = "annotation.human.task"
TASKS = ("open the drawer", "close the drawer", "valid", "push it")
WIDTH, HEIGHT = 64, 64
ENCODERS = {"h264": "libx264", "hevc": "libx265", "av1": "libsvtav1", "mpeg4": "mpeg4", "png": "png"}
_OPTIONS = {
    "libx264": {"bf": "2", "preset": "ultrafast"},
    "libx265": {"preset": "ultrafast", "x265-params": "log-level=none:bframes=0:pools=1:frame-threads=1"},
    "libsvtav1": {"preset": "12", "svtav1-params": "lp=1"},
    "mpeg4": {"qscale": "4"},
}


@dataclass(frozen=True, kw_only=True)
class DrawnDataset:
    """Random properties of a dataset.

    Attributes:
        version: "v2.1" or "v3.0".
        lengths: Frames of each episode.
        names: Form of the names of elements: "", "list", "nested", "motors" or "axes".
        stored: NumPy's type of the state and action in the data files.
        claimed: Their type in info.json.
        is_variable: Whether vectors are lists of any length in the data files.
        clock: "grid", "jitter" or "late".
        time_type: NumPy's type of timestamps.
        pixels: Pixel format of videos.
        camera: A codec, "image" (structs in rows), "binary" (plain bytes in rows) or "" for none.
        gop: Frames from one keyframe to the next.
        reference: NumPy's type of a column of numbers of tasks; "" for none.
        missing: Counters that the data files and info.json lack.
        num_files: Data files of a dataset of v3.0.
        extra: Scalar columns of these types; "bool[]" is a list of one.
        has_unlisted: Whether the data files have a column that info.json does not list.
    """

    version: str
    lengths: tuple[int, ...]
    names: str
    stored: str
    claimed: str
    is_variable: bool
    clock: str
    time_type: str
    camera: str
    gop: int
    reference: str
    missing: tuple[str, ...]
    num_files: int
    extra: tuple[str, ...]
    has_unlisted: bool
    pixels: str = "yuv420p"
    fps: int = 10

    @property
    def total(self) -> int:
        return sum(self.lengths)


DRAWN = st.builds(
    DrawnDataset,
    version=st.sampled_from(["v2.1", "v3.0"]),
    lengths=st.lists(st.integers(4, 8), min_size=2, max_size=4).map(tuple),
    names=st.sampled_from(["", "list", "nested", "motors", "axes"]),
    stored=st.sampled_from(["float32", "float64"]),
    claimed=st.sampled_from(["float32", "float64"]),
    is_variable=st.booleans(),
    clock=st.sampled_from(["grid", "jitter", "late"]),
    time_type=st.sampled_from(["float32", "float64"]),
    camera=st.sampled_from(["", "image", "binary", "h264", "hevc", "av1", "mpeg4"]),
    gop=st.sampled_from([1, 3, 100]),
    reference=st.sampled_from(["", "int64", "int32", "uint8"]),
    missing=st.sampled_from([(), ("frame_index",), ("index", "task_index"), ("timestamp",)]),
    num_files=st.integers(1, 3),
    extra=st.lists(st.sampled_from(["int32", "uint8", "bool", "bool[]", "string", "float64"]), max_size=3).map(tuple),
    has_unlisted=st.booleans(),
)


PLAIN = DrawnDataset(
    version="v2.1", lengths=(5, 6), names="list", stored="float32", claimed="float32", is_variable=True, clock="grid",
    time_type="float32", camera="h264", gop=3, reference="", missing=(), num_files=1, extra=(),
    has_unlisted=False,
)  # fmt: skip


def write_drawn(root: Path, drawn: DrawnDataset, seed: int = 0) -> Path:
    """Write the dataset; the first number of a row's state is unique among all datasets of a seed."""
    random = np.random.default_rng(seed)
    columns, features = _columns(drawn, random, seed)
    for name in drawn.missing:
        del columns[name], features[name]
    parts, first = [], 0
    for length in drawn.lengths:
        parts.append(pa.table(columns).slice(first, length))
        first += length
    info = {"codebase_version": drawn.version, "robot_type": "arm", "fps": drawn.fps, "features": features}
    task_of = [number % 2 for number in range(len(drawn.lengths))]
    more = _write_videos(root, drawn)
    write_tables(root, info, parts, TASKS, task_of=task_of, num_files=drawn.num_files, more=more)
    (root / "meta/notes of ours.txt").write_bytes(bytes([seed, 1, 2]))
    (root / "extra/deep").mkdir(parents=True)
    (root / "extra/deep/calibration.bin").write_bytes(random.bytes(20))
    return root


def _columns(drawn: DrawnDataset, random: np.random.Generator, seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
    total, episodes = drawn.total, np.repeat(np.arange(len(drawn.lengths)), drawn.lengths)
    frames = np.concatenate([np.arange(length) for length in drawn.lengths])
    state, action = (random.normal(size=(total, 3)) for _ in range(2))
    state[:, 0] = np.arange(total) + 1000 * seed
    times = frames / drawn.fps
    if drawn.clock != "grid":
        times += random.uniform(0, 0.03, total) if drawn.clock == "jitter" else 1.7
    names: Any = {"": None, "list": list("abc"), "nested": [list("abc")]}.get(drawn.names, {drawn.names: list("abc")})
    vector = {"dtype": drawn.claimed, "shape": [3], "names": names}
    scalar = {"shape": [1], "names": None}
    numbers: dict[str, Any] = {
        "timestamp": times.astype(drawn.time_type), "frame_index": frames, "episode_index": episodes,
        "index": np.arange(total), "task_index": episodes % 2,
    }  # fmt: skip
    features: dict[str, Any] = {STATE: vector, ACTION: vector}
    columns = {STATE: _vectors(state, drawn), ACTION: _vectors(action, drawn)}
    if drawn.reference:
        numbers[REFERENCE] = random.integers(0, len(TASKS), total).astype(drawn.reference)
    for place, kind in enumerate(drawn.extra):
        plain = kind.removesuffix("[]")
        values = random.integers(0, 2, total).astype("U1" if plain == "string" else plain)
        column = pa.array(values.tolist(), getattr(pa, plain if plain != "bool" else "bool_")())
        columns[f"extra_{place}"] = pa.array([[value] for value in values.tolist()]) if kind != plain else column
        features[f"extra_{place}"] = {"dtype": plain, **scalar}
    for name, values in numbers.items():
        columns[name] = pa.array(values)
        features[name] = {"dtype": drawn.claimed if name == "timestamp" else str(values.dtype), **scalar}
    if drawn.has_unlisted:
        columns["is_pad"] = pa.array(np.zeros(total, bool))
    if drawn.camera in ("image", "binary"):
        columns[TOP] = _stored_images(total, drawn.camera, seed)
    if drawn.camera:
        dtype = "image" if drawn.camera in ("image", "binary") else "video"
        features[TOP] = {"dtype": dtype, "shape": [HEIGHT, WIDTH, 3], "names": ["height", "width", "channels"]}
    return columns, features


def _vectors(values: np.ndarray[Any, Any], drawn: DrawnDataset) -> pa.Array:
    kind = pa.from_numpy_dtype(np.dtype(drawn.stored))
    return pa.array(values.astype(drawn.stored).tolist(), pa.list_(kind) if drawn.is_variable else pa.list_(kind, 3))


def _stored_images(total: int, kind: str, seed: int) -> pa.Array:
    images = []
    for row in range(total):
        file = io.BytesIO()
        Image.new("RGB", (WIDTH, HEIGHT), (row, seed, 0)).save(file, "PNG")
        images.append(file.getvalue())
    if kind == "binary":
        return pa.array(images, pa.binary())
    struct = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    return pa.array([{"bytes": image, "path": None} for image in images], struct)


def write_tables(
    root: Path,
    info: dict[str, Any],
    parts: Sequence[pa.Table],
    tasks: Sequence[str],
    *,
    task_of: Sequence[int] | None = None,
    num_files: int = 1,
    more: Mapping[str, Any] | None = None,
) -> None:
    """Write info.json, to which paths and counts are added, and the tables of a dataset of v2.0 to v3.0.

    Args:
        root: Folder of the dataset.
        info: Version, rate and features.
        parts: Rows of each episode.
        tasks: The instructions.
        task_of: Number of each episode's task; all have the first one by default.
        num_files: Data files of a dataset of v3.0.
        more: Further columns of the table of episodes of v3.0.
    """
    lengths, numbers = [len(part) for part in parts], range(len(parts))
    texts = [[tasks[number]] for number in task_of or [0] * len(parts)]
    is_old = info["codebase_version"] != "v3.0"
    name = "episode_chunk:03d}/episode_{episode_index:06d" if is_old else "chunk_index:03d}/file-{file_index:03d"
    info |= {
        "total_episodes": len(parts), "total_frames": sum(lengths), "total_tasks": len(tasks), "chunks_size": 1000,
        "splits": {"train": f"0:{len(parts)}"}, "data_path": f"data/chunk-{{{name}}}.parquet",
        "video_path": f"videos/chunk-{{{name.replace('/', '/{video_key}/')}}}.mp4" if is_old
        else f"videos/{{video_key}}/chunk-{{{name}}}.mp4",
    }  # fmt: skip
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / "data/chunk-000").mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    if is_old:
        for number, part in enumerate(parts):
            pq.write_table(part, root / f"data/chunk-000/episode_{number:06d}.parquet")
        rows = [{"episode_index": number, "tasks": texts[number], "length": lengths[number]} for number in numbers]
        (root / "meta/episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        lines = [json.dumps({"task_index": number, "task": task}) + "\n" for number, task in enumerate(tasks)]
        (root / "meta/tasks.jsonl").write_text("".join(lines))
        return
    files = [min(number, num_files - 1) for number in numbers]
    for file in set(files):
        table = pa.concat_tables(part for part, place in zip(parts, files, strict=True) if place == file)
        pq.write_table(table, root / f"data/chunk-000/file-{file:03d}.parquet")
    begins = np.cumsum([0, *lengths])
    episodes = {
        "episode_index": numbers, "length": lengths, "tasks": texts, "data/chunk_index": [0] * len(parts),
        "data/file_index": files, "dataset_from_index": begins[:-1], "dataset_to_index": begins[1:],
    }  # fmt: skip
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.table({**episodes, **(more or {})}), root / "meta/episodes/chunk-000/file-000.parquet")
    pq.write_table(pa.table({"task": tasks, "task_index": range(len(tasks))}), root / "meta/tasks.parquet")


def _write_videos(root: Path, drawn: DrawnDataset) -> dict[str, Any]:
    """Write the videos, and return their columns of the table of episodes of v3.0."""
    if drawn.camera not in ENCODERS:
        return {}
    if drawn.version == "v2.1":
        for number, length in enumerate(drawn.lengths):
            path = root / f"videos/chunk-000/{TOP}/episode_{number:06d}.mp4"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(encoded(drawn.camera, length, drawn.gop, drawn.pixels))
        return {}
    path = root / f"videos/{TOP}/chunk-000/file-000.mp4"
    path.parent.mkdir(parents=True)
    path.write_bytes(encoded(drawn.camera, drawn.total, drawn.gop, drawn.pixels))
    begins = np.cumsum([0, *drawn.lengths]) / drawn.fps
    zeros = [0] * len(drawn.lengths)
    columns = {"chunk_index": zeros, "file_index": zeros, "from_timestamp": begins[:-1], "to_timestamp": begins[1:]}
    return {f"videos/{TOP}/{name}": column for name, column in columns.items()}


@functools.cache
def encoded(codec: str, length: int, gop: int, pixels: str = "yuv420p", *, is_fragmented: bool = False) -> bytes:
    """An mp4 file of some frames at 10 Hz: a square that moves over a table."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.uint8)
    table = np.stack([2 * rows, 2 * columns, rows + columns], axis=-1)
    file = io.BytesIO()
    # A fragmented file has no edit list to shift the first image to 0 when it uses B-frames.
    in_order = {"bf": "0"} if is_fragmented else {}
    options = {"movflags": "frag_keyframe+empty_moov+default_base_moof"} if is_fragmented else {}
    with av.open(file, "w", format="mp4", options=options) as out:
        name = ENCODERS[codec]
        stream = out.add_stream(name, rate=10, options={"g": str(gop), **_OPTIONS.get(name, {}), **in_order})
        assert isinstance(stream, VideoStream)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pixels
        for number in range(length):
            image = table.copy()
            image[number : number + 20, 5:25] = (200, 90, 7 * number)
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts = number
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return file.getvalue()


def write_v21(root: Path) -> Path:
    """Write two episodes of 5 and 6 frames in the format v2.1, with their statistics."""
    write_drawn(root, replace(PLAIN, gop=1))  # images that an import keeps
    lines = []
    for number, length in enumerate(PLAIN.lengths):
        table = pq.read_table(root / f"data/chunk-000/episode_{number:06d}.parquet")
        stats: dict[str, Any] = {}
        for name in table.column_names:
            rows = np.array(table[name].to_pylist(), np.float64).reshape(length, -1)
            moments = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
            stats[name] = {**{key: row.tolist() for key, row in moments.items()}, "count": [length]}
        stats[TOP] = {**{key: [[[0.5]]] * 3 for key in ("min", "max", "mean", "std")}, "count": [length]}
        lines.append(json.dumps({"episode_index": number, "stats": stats}) + "\n")
    (root / "meta/episodes_stats.jsonl").write_text("".join(lines))
    tasks = (root / "meta/tasks.jsonl").read_text().splitlines(keepends=True)
    (root / "meta/tasks.jsonl").write_text("".join(tasks[: len(PLAIN.lengths)]))  # those in use
    info = root / "meta/info.json"
    info.write_text(info.read_text().replace(f'"total_tasks": {len(TASKS)}', '"total_tasks": 2'))
    return root


def like(drawn: DrawnDataset) -> DrawnDataset:
    """A dataset with other episodes that can be merged with the given one."""
    return replace(drawn, lengths=drawn.lengths[::-1], clock="grid", num_files=1)
