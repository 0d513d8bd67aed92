"""Damage the files of a written dataset."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from support.doctor_bases import DatasetBase

FileFault = Callable[[Path, DatasetBase, int], None]
RANGE = ("dataset_from_index", "dataset_to_index")
"""Columns of the table of episodes with the rows of an episode."""


def data_file(root: Path, number: int) -> Path:
    """Table that holds an episode."""
    files = sorted(root.glob("data/*/*.parquet"))
    return files[number] if len(files) > 1 else files[0]


def video_file(root: Path, number: int) -> Path:
    """Video that holds an episode."""
    files = sorted(root.glob("videos/*/*/*.mp4"))
    return next((path for path in files if path.stem == f"episode_{number:06d}"), files[0])


def cut(find: Callable[[Path, int], Path], share: float) -> FileFault:
    def spoil(root: Path, base: DatasetBase, number: int) -> None:
        path = find(root, number)
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])

    return spoil


def noisy_video(root: Path, base: DatasetBase, number: int) -> None:
    path = video_file(root, number)
    data = bytearray(path.read_bytes())
    begin, end = len(data) // 3, len(data) // 2
    data[begin:end] = np.random.default_rng(0).integers(0, 256, end - begin, np.uint8).tobytes()
    path.write_bytes(data)


def short_video(root: Path, base: DatasetBase, number: int) -> None:
    """Drop the last fifth of the images, as an encoder that is too slow does."""
    path = video_file(root, number)
    with av.open(str(path)) as source, av.open(str(path.with_suffix(".tmp.mp4")), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        packets = [packet for packet in source.demux(video=0) if packet.dts is not None]
        for packet in packets[: len(packets) * 4 // 5]:
            packet.stream = stream
            target.mux(packet)
    path.with_suffix(".tmp.mp4").replace(path)


def json_file(name: str, change: Callable[[Any], object]) -> FileFault:
    def spoil(root: Path, base: DatasetBase, number: int) -> None:
        content = json.loads((root / name).read_text())
        change(content)
        (root / name).write_text(json.dumps(content, indent=4))

    return spoil


def camera_info(values: dict[str, Any]) -> FileFault:
    def change(info: Any) -> None:
        for name, feature in info["features"].items():
            if name.startswith("observation.images"):
                feature["info"] |= values

    return json_file("meta/info.json", change)


def episode_row(change: Callable[[dict[str, Any], dict[str, Any]], object]) -> FileFault:
    """Change a row in the table of episodes; `change` also gets the next row."""

    def spoil(root: Path, base: DatasetBase, number: int) -> None:
        if base.version == "v2.1":
            path = root / "meta/episodes.jsonl"
            rows = [json.loads(line) for line in path.read_text().splitlines()]
            change(rows[number], rows[number + 1])
            path.write_text("".join(json.dumps(row) + "\n" for row in rows))
            return
        path = root / "meta/episodes/chunk-000/file-000.parquet"
        rows = pq.read_table(path).to_pylist()
        change(rows[number], rows[number + 1])
        pq.write_table(pa.Table.from_pylist(rows), path)

    return spoil


def data_column(name: str, change: Callable[[NDArray[Any], int, NDArray[Any]], object]) -> FileFault:
    """Change a column of counters; `change` gets its values, the episode and the episodes of the rows."""

    def spoil(root: Path, base: DatasetBase, number: int) -> None:
        path = data_file(root, number)
        table = pq.read_table(path)
        values = table.column(name).to_numpy().copy()
        change(values, number, table.column("episode_index").to_numpy())
        pq.write_table(table.set_column(table.schema.get_field_index(name), name, pa.array(values)), path)

    return spoil


def another_task(values: NDArray[Any], number: int, episodes: NDArray[Any]) -> None:
    values[episodes == number] = 1 - values[episodes == number]


def no_such_task(values: NDArray[Any], number: int, episodes: NDArray[Any]) -> None:
    values[episodes == number] = 7


def restarted(values: NDArray[Any], number: int, episodes: NDArray[Any]) -> None:
    rows = np.flatnonzero(episodes == number)
    values[rows[len(rows) // 2 :]] += 5


def statistics(feature: str, name: str, factor: float) -> FileFault:
    """Falsify one statistic of a feature in the file that training reads."""

    def spoil(root: Path, base: DatasetBase, number: int) -> None:
        key = base.feature(feature)
        if base.version != "v2.1":
            path = root / "meta/stats.json"
            content = json.loads(path.read_text())
            content[key][name] = (np.array(content[key][name]) * factor + 0.5).tolist()
            path.write_text(json.dumps(content))
            return
        path = root / "meta/episodes_stats.jsonl"
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        values = lines[number]["stats"][key]
        values[name] = (np.array(values[name]) * factor + 0.5).tolist()
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))

    return spoil


def unlinked(find: Callable[[Path, int], Path]) -> FileFault:
    return lambda root, base, number: find(root, number).unlink()


def episode_table(root: Path, number: int) -> Path:
    old = root / "meta/episodes.jsonl"
    return old if old.exists() else root / "meta/episodes/chunk-000/file-000.parquet"


def stray(root: Path, base: DatasetBase, number: int) -> None:
    path = data_file(root, number)
    name = "episode_000099.parquet" if base.version == "v2.1" else "file-007.parquet"
    path.with_name(name).write_bytes(path.read_bytes())


def stray_video(root: Path, base: DatasetBase, number: int) -> None:
    path = video_file(root, number)
    path.with_name("episode_000099.mp4").write_bytes(path.read_bytes())
