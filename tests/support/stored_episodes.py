"""Episodes of a LeRobot dataset as PyArrow and libav read them from its files, to compare before and after an edit."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

COUNTERS = ("index", "episode_index", "frame_index", "task_index", "timestamp")


@dataclass(frozen=True, kw_only=True)
class StoredEpisode:
    """One episode.

    Attributes:
        columns: Column -> its values, one a row; counters included.
        types: Column -> Arrow's type of a number in it.
        tasks: Text of each row's task.
        packets: Camera -> the encoded image of each row.
    """

    columns: dict[str, list[Any]]
    types: dict[str, str]
    tasks: list[str]
    packets: dict[str, list[bytes]]

    def cut(self, first: int, last: int) -> StoredEpisode:
        """The frames from `first` to before `last`."""
        return StoredEpisode(
            columns={name: values[first:last] for name, values in self.columns.items()},
            types=self.types,
            tasks=self.tasks[first:last],
            packets={name: packets[first:last] for name, packets in self.packets.items()},
        )


def task_texts(root: Path) -> dict[int, str]:
    if (path := root / "meta/tasks.parquet").exists():
        rows = pq.read_table(path).to_pylist()
    else:
        rows = [json.loads(line) for line in (root / "meta/tasks.jsonl").read_text().splitlines()]
    return {row["task_index"]: row.get("task") or row.get("__index_level_0__") for row in rows}


def stored_episodes(root: Path) -> list[StoredEpisode]:
    """Read all episodes of a dataset of v3.0 or v2.1, in order."""
    info = json.loads((root / "meta/info.json").read_text())
    table = _episode_table(root, info)
    cameras = [name for name, feature in info["features"].items() if feature["dtype"] == "video"]
    texts, parts = task_texts(root), {}
    for path in sorted(root.glob("data/*/*.parquet")):
        rows = pq.read_table(path)
        if "episode_index" not in rows.column_names:  # a file that does not belong to the dataset
            continue
        numbers = rows["episode_index"].to_numpy()
        for number in dict.fromkeys(numbers.tolist()):
            parts[int(number)] = rows.filter(pa.array(numbers == number))
    found = []
    for row in table:
        rows = parts[row["episode_index"]]
        columns = {name: rows[name].to_pylist() for name in rows.column_names}
        found.append(
            StoredEpisode(
                columns=columns,
                types={name: _number_type(rows.schema.field(name).type) for name in rows.column_names},
                tasks=[texts[int(number)] for number in columns["task_index"]]
                if "task_index" in columns
                else list(row["tasks"]) * len(rows),
                packets={name: _packets(root, info, row, name) for name in cameras},
            )
        )
    return found


def _number_type(kind: pa.DataType) -> str:
    while pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    return str(kind)


def _episode_table(root: Path, info: dict[str, Any]) -> list[dict[str, Any]]:
    if info["codebase_version"] != "v3.0":
        rows = [json.loads(line) for line in (root / "meta/episodes.jsonl").read_text().splitlines()]
    else:
        rows = [row for path in sorted(root.glob("meta/episodes/*/*")) for row in pq.read_table(path).to_pylist()]
    return sorted(rows, key=lambda row: int(row["episode_index"]))


def _packets(root: Path, info: dict[str, Any], row: dict[str, Any], camera: str) -> list[bytes]:
    """Encoded images of an episode, in display order."""
    number, first = row["episode_index"], 0
    if info["codebase_version"] == "v3.0":
        chunk, file, start = (
            row[f"videos/{camera}/{name}"] for name in ("chunk_index", "file_index", "from_timestamp")
        )
        path = info["video_path"].format(video_key=camera, chunk_index=chunk, file_index=file)
        first = round(start * info["fps"])
    else:
        chunk = number // info["chunks_size"]
        places = {"episode_chunk": chunk, "chunk_index": chunk, "episode_index": number}
        path = info["video_path"].format(video_key=camera, **places)
    shown = {}
    with av.open(str(root / path)) as container:
        for packet in container.demux(video=0):
            if packet.size:
                assert packet.pts is not None
                assert packet.time_base is not None
                shown[round(packet.pts * packet.time_base * info["fps"])] = bytes(packet)
    return [shown[frame] for frame in range(first, first + row["length"])]


def same_values(before: StoredEpisode, after: StoredEpisode, but: tuple[str, ...] = ()) -> list[str]:
    """Differences between two episodes, except their place in the dataset."""
    wrong = [
        name
        for name in {*before.columns, *after.columns} - {*COUNTERS, *but}
        if repr(before.columns.get(name)) != repr(after.columns.get(name))  # so that NaN equals itself
        or before.types[name] != after.types[name]
    ]
    wrong += [camera for camera in before.packets if before.packets[camera] != after.packets.get(camera)]
    if before.tasks != after.tasks:
        wrong.append("task")
    return wrong


def is_counted(episodes: list[StoredEpisode]) -> bool:
    """Whether the counters of an edited dataset rise without a gap."""
    index = [number for episode in episodes for number in episode.columns["index"]]
    return index == list(range(len(index))) and all(
        episode.columns["frame_index"] == list(range(len(episode.tasks)))
        and set(episode.columns["episode_index"]) == {number}
        for number, episode in enumerate(episodes)
    )


def seconds(episode: StoredEpisode) -> np.ndarray[Any, Any]:
    return np.array(episode.columns["timestamp"])
