"""Edits of a LeRobot dataset's files such as converters, merges and hands make them; statistics follow on demand.

Datasets of one file each of rows, episodes and images of a camera are meant. Nothing here knows what a check looks at.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

Rows = NDArray[Any]
Table = Callable[[pa.Table], pa.Table]
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_VIDEO = {"h264": "libx264", "av1": "libsvtav1", "hevc": "libx265"}


def info_of(dataset: Path) -> dict[str, Any]:
    """info.json."""
    found: dict[str, Any] = json.loads((dataset / "meta/info.json").read_text())
    return found


def write_json(path: Path, content: object) -> None:
    """A JSON file anew."""
    path.write_text(json.dumps(content))


def file_of(dataset: Path, place: str) -> Path:
    """The only file of a folder of chunks, or the file itself."""
    path = dataset / place
    return path if path.is_file() else next(path.glob("*/file-*"))


def table_of(dataset: Path, place: str = "data") -> pa.Table:
    """Of the only file there."""
    return pq.read_table(file_of(dataset, place))


def edit_table(dataset: Path, place: str, change: Table) -> None:
    """Another table in its place; ValueError if it is the same."""
    before = table_of(dataset, place)
    table = change(before)
    if table.equals(before):
        raise ValueError("nothing is changed")
    pq.write_table(table, file_of(dataset, place))


def replaced(table: pa.Table, name: str, values: Any) -> pa.Table:
    """Other values of a column that is there; ValueError if it is not."""
    place = table.column_names.index(name)
    values = values.tolist() if isinstance(values, np.ndarray) else values
    return table.set_column(place, table.schema.field(name), pa.array(values, table.schema.field(name).type))


def edit_cells(dataset: Path, place: str, name: str, change: Callable[[list[Any]], list[Any]]) -> None:
    """Another list of a column's values."""
    edit_table(dataset, place, lambda table: replaced(table, name, change(table.column(name).to_pylist())))


def parts_of(dataset: Path) -> list[slice]:
    """The rows of each episode."""
    ends = np.cumsum(table_of(dataset, "meta/episodes").column("length").to_pylist())
    return [slice(int(a), int(b)) for a, b in zip([0, *ends[:-1]], ends, strict=True)]


def rows_of(dataset: Path, name: str) -> Rows:
    """(T,) or (T, N) of a feature of numbers; ValueError if it is not there."""
    table = table_of(dataset)
    return np.array(table.column(table.column_names.index(name)).to_pylist())


def put_rows(dataset: Path, name: str, rows: Rows, *, restat: bool = True) -> None:
    """Other numbers, and their statistics with them."""
    kind = info_of(dataset)["features"][name]["dtype"]
    pq.write_table(replaced(table_of(dataset), name, rows.astype(kind)), file_of(dataset, "data"))
    if restat:
        put_statistics(dataset, name, np.atleast_2d(rows.astype(kind).T).T.astype(np.float64), [len(rows)])


def statistics(rows: Rows) -> dict[str, Rows]:
    """(T, N) -> ten numbers as LeRobot names them, each (N,)."""
    columns = np.ascontiguousarray(rows.T)  # several times faster than down a table of pixels
    found = {"min": columns.min(axis=1), "max": columns.max(axis=1), "mean": columns.mean(axis=1)}
    quantiles = np.quantile(columns, list(QUANTILES.values()), axis=1)
    return found | {"std": columns.std(axis=1)} | dict(zip(QUANTILES, quantiles, strict=True))


def put_statistics(dataset: Path, name: str, rows: Rows, count: Sequence[int]) -> None:
    """Statistics of (T, N) numbers or (T, H, W, 3) images in 0..255, of all and of each episode."""
    pixels = rows.ndim == 4
    parts = parts_of(dataset)
    episodes = table_of(dataset, "meta/episodes")

    def of(part: slice) -> dict[str, Any]:
        chosen = rows[part][::4].reshape(-1, 3) / 255 if pixels else rows[part]
        return {k: v.reshape(-1, 1, 1).tolist() if pixels else v.tolist() for k, v in statistics(chosen).items()}

    of_each = [of(part) for part in parts]
    for quantity in of_each[0]:
        episodes = replaced(episodes, f"stats/{name}/{quantity}", [found[quantity] for found in of_each])
    if not pixels:
        episodes = replaced(episodes, f"stats/{name}/count", [[part.stop - part.start] for part in parts])
    pq.write_table(episodes, file_of(dataset, "meta/episodes"))
    stats = json.loads((dataset / "meta/stats.json").read_text())
    stats[name] |= of(slice(0, len(rows))) | ({} if pixels else {"count": list(count)})
    write_json(dataset / "meta/stats.json", stats)


def cameras_of(dataset: Path) -> list[str]:
    """Features that are videos."""
    return [name for name, feature in info_of(dataset)["features"].items() if feature["dtype"] == "video"]


def images_of(dataset: Path, camera: str) -> Rows:
    """(T, H, W, 3) of the only file."""
    import av

    with av.open(str(file_of(dataset, f"videos/{camera}"))) as container:
        frames = list(container.decode(video=0))
    return np.stack([frame.to_ndarray(format="rgb24") for frame in frames])


def put_images(
    dataset: Path, camera: str, images: Rows, *, rate: int | None = None, crf: int = 18, restat: bool = True
) -> None:
    """Other images, coded anew, and their statistics with them."""
    import av

    info = info_of(dataset)
    codec = _VIDEO[info["features"][camera]["info"]["video.codec"]]
    with av.open(str(file_of(dataset, f"videos/{camera}")), "w") as container:
        options = {"crf": str(crf), "g": "2", "bf": "0"}
        stream: Any = container.add_stream(codec, rate=rate or info["fps"], options=options)
        stream.height, stream.width = images.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")))
        container.mux(stream.encode(None))
    if restat:
        put_statistics(dataset, camera, images, ())


def reframe(dataset: Path, picks: Sequence[Rows], *, images: bool = True) -> None:
    """Episodes of other rows: each a list of rows of the whole table. All that follows from them is made again.

    The first episodes keep what else is known of them; there may be fewer episodes, or one more.
    """
    info, taken = info_of(dataset), np.concatenate(picks)
    films = {camera: images_of(dataset, camera)[taken] for camera in cameras_of(dataset)} if images else {}
    table = table_of(dataset).take(pa.array(taken))
    frames = np.concatenate([np.arange(len(pick)) for pick in picks])
    for name, rows in {
        "timestamp": frames / info["fps"],
        "frame_index": frames,
        "episode_index": np.repeat(np.arange(len(picks)), [len(pick) for pick in picks]),
        "index": np.arange(len(taken)),
        "next.done": np.concatenate([np.arange(len(pick)) == len(pick) - 1 for pick in picks]),
    }.items():
        table = replaced(table, name, rows)
    pq.write_table(table, file_of(dataset, "data"))
    _number_anew(dataset, [len(pick) for pick in picks], info)
    for name, feature in info["features"].items():
        if feature["dtype"] not in ("video", "language"):
            put_rows(dataset, name, rows_of(dataset, name))
    for camera, film in films.items():
        put_images(dataset, camera, film)


def _number_anew(dataset: Path, lengths: Sequence[int], info: dict[str, Any]) -> None:
    """The episodes' table and the totals for episodes of other lengths."""
    table = table_of(dataset, "meta/episodes")
    table = table.take(pa.array(np.minimum(np.arange(len(lengths)), table.num_rows - 1)))
    ends = np.cumsum(lengths)
    table = replaced(replaced(table, "episode_index", np.arange(len(lengths))), "length", list(lengths))
    table = replaced(replaced(table, "dataset_from_index", ends - lengths), "dataset_to_index", ends)
    for camera in cameras_of(dataset):
        table = replaced(table, f"videos/{camera}/from_timestamp", (ends - lengths) / info["fps"])
        table = replaced(table, f"videos/{camera}/to_timestamp", ends / info["fps"])
    pq.write_table(table, file_of(dataset, "meta/episodes"))
    totals = {"total_episodes": len(lengths), "total_frames": int(ends[-1]), "splits": {"train": f"0:{len(lengths)}"}}
    write_json(dataset / "meta/info.json", info | totals)
