"""Faults of LeRobot datasets as functions of their folder, made of changes of rows, images, tables and files."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from support import loose
from support.check import edit_json
from support.loose import Rows

Fault = Callable[[Path], None]
Change = Callable[[Rows], Rows]
Entry = dict[str, Any]

FRONT, WRIST = "observation.images.front", "observation.images.wrist"


def numbers(name: str, change: Change, *, only: Sequence[int] | None = None, restat: bool = True) -> Fault:
    """Other numbers in each episode, or in some."""

    def fault(dataset: Path) -> None:
        before = loose.rows_of(dataset, name).astype(np.float64)
        rows = before.copy()
        for number, part in enumerate(loose.parts_of(dataset)):
            if only is None or number in only:
                rows[part] = change(rows[part].copy())
        if np.array_equal(rows, before):
            raise ValueError("nothing is changed")
        loose.put_rows(dataset, name, rows, restat=restat)

    return fault


def alike(change: Change, *names: str, only: Sequence[int] | None = None) -> Fault:
    """The same change of several features."""
    return lambda dataset: [numbers(name, change, only=only)(dataset) for name in names] and None


def reframed(pick: Callable[[list[Rows], int], list[Rows]]) -> Fault:
    """Other rows, with their images."""

    def fault(dataset: Path) -> None:
        parts = [np.arange(part.start, part.stop) for part in loose.parts_of(dataset)]
        loose.reframe(dataset, pick(parts, loose.info_of(dataset)["fps"]))

    return fault


def one(change: Callable[[Rows, int], Rows]) -> Fault:
    """Other rows of the second episode."""
    return reframed(lambda parts, fps: [parts[0], change(parts[1], fps), *parts[2:]])


def film(camera: str, change: Change, *, only: Sequence[int] | None = (1,), **coded: int) -> Fault:
    """Other images in some episodes; None: in all."""

    def fault(dataset: Path) -> None:
        images = loose.images_of(dataset, camera)
        for number, part in enumerate(loose.parts_of(dataset)):
            if only is None or number in only:
                images[part] = np.clip(change(images[part].copy()), 0, 255)
        loose.put_images(dataset, camera, images, **coded)

    return fault


def both(change: Callable[[Rows, Rows], tuple[Rows, Rows]]) -> Fault:
    """Other images of both cameras in the second episode."""

    def fault(dataset: Path) -> None:
        a, b, part = *(loose.images_of(dataset, name) for name in (FRONT, WRIST)), loose.parts_of(dataset)[1]
        a[part], b[part] = change(a[part].copy(), b[part].copy())
        loose.put_images(dataset, FRONT, a)
        loose.put_images(dataset, WRIST, b)

    return fault


def cells(place: str, name: str, change: Callable[[list[Any]], list[Any]]) -> Fault:
    """Other values of a table's column."""
    return lambda dataset: loose.edit_cells(dataset, place, name, change)


def table(place: str, change: loose.Table) -> Fault:
    """Another table."""
    return lambda dataset: loose.edit_table(dataset, place, change)


def of_json(place: str, change: Callable[[Any], object]) -> Fault:
    """Another JSON file."""
    return lambda dataset: edit_json(dataset / place, lambda data: change(data) and None)


def info(change: Callable[[Any], object]) -> Fault:
    """Another info.json."""
    return of_json("meta/info.json", change)


def stats(change: Callable[[Any], object]) -> Fault:
    """Another stats.json."""
    return of_json("meta/stats.json", change)


def at(number: int, value: Callable[[Any], Any]) -> Callable[[list[Any]], list[Any]]:
    """One value of a list, changed."""
    return lambda values: [value(v) if n == number else v for n, v in enumerate(values)]


def swap(values: list[Any]) -> list[Any]:
    """The first two values exchanged."""
    return [values[1], values[0], *values[2:]]


def spoken(style: str, change: Callable[[Entry], object], column: str = "language_persistent") -> Fault:
    """Each entry of a style."""

    def edit(rows: list[list[Entry]]) -> list[list[Entry]]:
        for row in rows:
            for entry in row:
                if entry["style"] == style:
                    change(entry)
        return rows

    return said(column, edit)


def said(column: str, edit: Callable[[list[list[Entry]]], list[list[Entry]]]) -> Fault:
    """Other language in the rows."""
    fields = {name: pa.string() for name in ("role", "content", "style")}
    fields |= {"timestamp": pa.float32()} if column == "language_persistent" else {}
    kind = pa.list_(pa.struct(list((fields | {"camera": pa.string(), "tool_calls": pa.list_(pa.string())}).items())))

    def change(rows: pa.Table) -> pa.Table:
        place = rows.column_names.index(column)
        before = rows.column(column).to_pylist()
        return rows.set_column(place, column, pa.array(edit(json.loads(json.dumps(before))), kind))

    return table("data", change)


def on_disk(pattern: str, change: Callable[[Path], object]) -> Fault:
    """A change of a file; ValueError where there is none."""

    def fault(dataset: Path) -> None:
        paths = sorted(dataset.glob(pattern))
        if not paths:
            raise ValueError(pattern)
        change(paths[0])

    return fault


def cut(path: Path) -> None:
    """Half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def pointer(path: Path) -> None:
    """What a download without Git LFS leaves."""
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    path.write_text(f"version https://git-lfs.github.com/spec/v1\noid sha256:{digest}\nsize {path.stat().st_size}\n")


def hole(path: Path) -> None:
    """Zeros in the middle, as a resumed download leaves."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 4096] = bytes(len(data[len(data) // 2 : len(data) // 2 + 4096]))
    path.write_bytes(data)


def late(rows: Rows, by: int) -> Rows:
    """So many frames late, or early."""
    return rows[np.clip(np.arange(len(rows)) - by, 0, len(rows) - 1)]


def columns(rows: Rows, chosen: Any, change: Change) -> Rows:
    """Some columns, changed."""
    rows[:, chosen] = change(rows[:, chosen])
    return rows


def exchanged(rows: Rows, a: int, b: int) -> Rows:
    """Two columns."""
    rows[:, [a, b]] = rows[:, [b, a]]
    return rows


def halved(rows: Rows) -> Rows:
    """Every second row is the mean of its neighbours."""
    rows[1:-1:2] = (rows[0:-2:2][: len(rows[1:-1:2])] + rows[2::2][: len(rows[1:-1:2])]) / 2
    return rows


def middle(rows: Rows, count: int, value: Any) -> Rows:
    """Other values for some rows from the middle on."""
    rows[len(rows) // 2 : len(rows) // 2 + count] = value
    return rows


def filtered(rows: Rows, keep: float = 0.85) -> Rows:
    """A low-pass filter."""
    for t in range(1, len(rows)):
        rows[t] = keep * rows[t - 1] + (1 - keep) * rows[t]
    return rows


def frozen(rows: Rows, first: int, count: int) -> Rows:
    """One value for so long."""
    rows[first : first + count] = rows[first]
    return rows


def pixels(change: Callable[[Rows], Rows]) -> Change:
    """Of images as numbers in 0..255."""
    return lambda rows: np.clip(change(rows.astype(np.float32)), 0, 255).astype(np.uint8)


def scaled(rows: Rows, height: float, width: float) -> Rows:
    """The image around its centre, so much larger in each direction; black outside."""
    h, w = rows.shape[1:3]
    y = np.round((np.arange(h) - h / 2) / height + h / 2).astype(int)
    x = np.round((np.arange(w) - w / 2) / width + w / 2).astype(int)
    out = rows[:, np.clip(y, 0, h - 1)][:, :, np.clip(x, 0, w - 1)]
    return out * (((y >= 0) & (y < h))[:, None] & ((x >= 0) & (x < w)))[None, :, :, None].astype(np.uint8)


def blurred(rows: Rows) -> Rows:
    """Means of 5 x 5 pixels."""
    out = np.pad(rows.astype(np.float32), ((0, 0), (2, 2), (2, 2), (0, 0)), mode="edge")
    h, w = rows.shape[1:3]
    return np.mean([out[:, y : y + h, x : x + w] for y in range(5) for x in range(5)], axis=0).astype(np.uint8)


def noisy(scale: float) -> Change:
    """Noise of numbers."""
    return lambda rows: rows + np.random.default_rng(0).normal(0, scale, rows.shape)


# --------------------------------------------------------------------------------------------------- particular changes


def middle_all(rows: Rows, chosen: Any, factor: float) -> Rows:
    """Some columns times a factor, from the middle on."""
    rows[len(rows) // 2 :, chosen] *= factor
    return rows


def turned(rows: Rows) -> Rows:
    """A turn more from the middle on."""
    return rows + 2 * np.pi * (np.arange(len(rows)) >= len(rows) // 2)


def held(rows: Rows, times: int) -> Rows:
    """Each value so many times, at the same length."""
    return rows[np.arange(len(rows)) // times * times]


def repeats(rows: Rows, every: int) -> Rows:
    """Some rows repeat the one before."""
    rows[every::every] = rows[every - 1 : -1 : every][: len(rows[every::every])]
    return rows


def normalised(rows: Rows) -> Rows:
    """Each column in -1 to 1."""
    return 2 * (rows - rows.min(axis=0)) / np.maximum(np.ptp(rows, axis=0), 1e-9) - 1


def exchanged_features(a: str, b: str) -> Fault:
    """Two features of the same width; ValueError where they are not."""

    def fault(dataset: Path) -> None:
        rows = loose.rows_of(dataset, a), loose.rows_of(dataset, b)
        if rows[0].shape != rows[1].shape:
            raise ValueError(a)
        loose.put_rows(dataset, a, rows[1])
        loose.put_rows(dataset, b, rows[0])

    return fault


def both_tables(text: str) -> Fault:
    """Every task has one text."""

    def fault(dataset: Path) -> None:
        loose.edit_cells(
            dataset, "meta/tasks.parquet", "task", lambda v: [f"{text} {n}".strip() for n in range(len(v))]
        )
        numbers_of = [int(loose.rows_of(dataset, "task_index")[part][0]) for part in loose.parts_of(dataset)]
        loose.edit_cells(dataset, "meta/episodes", "tasks", lambda v: [[f"{text} {n}".strip()] for n in numbers_of])

    return fault


def film_ranges(dataset: Path, change: Callable[[list[float], list[float]], tuple[list[Any], list[Any]]]) -> None:
    """Other times of the front camera's images."""
    names = [f"videos/{FRONT}/{end}_timestamp" for end in ("from", "to")]
    found = loose.table_of(dataset, "meta/episodes")
    changed = change(*(found.column(name).to_pylist() for name in names))
    for name, values in zip(names, changed, strict=True):
        loose.edit_cells(dataset, "meta/episodes", name, lambda _, values=values: values)


def exchanged_films(dataset: Path) -> None:
    """The times of the first two episodes' images."""
    film_ranges(dataset, lambda a, b: (swap(a), swap(b)))


def range_late(dataset: Path) -> None:
    """Half a second later in the second episode."""
    film_ranges(dataset, lambda a, b: (at(1, lambda t: t + 0.5)(a), at(1, lambda t: t + 0.5)(b)))


def renamed(info: Entry, change: Callable[[str, list[str]], list[str]]) -> None:
    """Other names of the columns of numbers."""
    for name, feature in info["features"].items():
        if feature["dtype"] != "video" and feature["names"]:
            feature["names"] = change(name, feature["names"])


def exchange(stats: Entry, a: str, b: str) -> None:
    """Two features' statistics; ValueError where their widths differ."""
    if len(stats[a]["mean"]) != len(stats[b]["mean"]):
        raise ValueError(a)
    stats[a], stats[b] = stats[b], stats[a]


def stats_of_first(dataset: Path) -> None:
    """As if nothing had been merged into the dataset since its first episode."""
    first = loose.table_of(dataset, "meta/episodes").slice(0, 1).to_pylist()[0]
    found = json.loads((dataset / "meta/stats.json").read_text())
    for name, values in found.items():
        values.update({quantity: first[f"stats/{name}/{quantity}"] for quantity in values})
    loose.write_json(dataset / "meta/stats.json", found)


def stats_mean_of_means(dataset: Path) -> None:
    """Means that forget how long the episodes are."""
    rows = loose.table_of(dataset, "meta/episodes")

    def change(found: Entry) -> None:
        for name, values in found.items():
            values["mean"] = np.mean(rows.column(f"stats/{name}/mean").to_pylist(), axis=0).tolist()

    stats(change)(dataset)


def exchanged_files(dataset: Path) -> None:
    """The files of two cameras."""
    a, b = (loose.file_of(dataset, f"videos/{name}") for name in (FRONT, WRIST))
    data = a.read_bytes(), b.read_bytes()
    a.write_bytes(data[1])
    b.write_bytes(data[0])


def one_file_for_both(dataset: Path) -> None:
    """The file of one camera for both."""
    a, b = (loose.file_of(dataset, f"videos/{name}") for name in (FRONT, WRIST))
    b.write_bytes(a.read_bytes())


def film_of_other(dataset: Path) -> None:
    """The second episode shows what the first one shows, as long as it lasts."""
    images, (first, second, *_) = loose.images_of(dataset, FRONT), loose.parts_of(dataset)
    images[second] = images[first][np.minimum(np.arange(second.stop - second.start), first.stop - first.start - 1)]
    loose.put_images(dataset, FRONT, images)


def first_of_other(dataset: Path) -> None:
    """The second episode's first images are the last ones of the first, all frames a second late."""
    images, (_, second, *_), fps = (
        loose.images_of(dataset, WRIST),
        loose.parts_of(dataset),
        loose.info_of(dataset)["fps"],
    )
    images[second] = images[second.start - fps : second.stop - fps].copy()
    loose.put_images(dataset, WRIST, images)


def blocks(rows: Rows) -> Rows:
    """Green blocks in five images."""
    place = len(rows) // 3
    rows[place : place + 5, 16:48, 32:64] = (0, 135, 0)
    return rows


def spot(rows: Rows) -> Rows:
    """Dirt on the lens."""
    rows[:, 40:48, 40:48] //= 4
    return rows


def bar(rows: Rows) -> Rows:
    """A black bar at the image's lower end."""
    rows[:, -16:] = 0
    return rows


def first_subtask(rows: list[list[Entry]]) -> list[list[Entry]]:
    """Only the subtask of the beginning."""
    return [[e for e in row if e["style"] != "subtask" or e["timestamp"] == 0] for row in rows]


def points(change: Callable[[float, float], list[float]]) -> Callable[[Entry], None]:
    """Other points of a trace."""

    def apply(entry: Entry) -> None:
        if entry["role"] == "assistant":
            told = json.loads(entry["content"])
            told["points"] = [change(x, y) for x, y in told["points"]]
            entry["content"] = json.dumps(told)

    return apply


def other_camera(entry: Entry) -> None:
    """The other of the two."""
    entry["camera"] = WRIST if entry["camera"] == FRONT else FRONT


def heavier(told: str) -> str:
    """The movable bodies of an EpisodeInfo's JSON have twice their mass."""
    found = json.loads(told)
    for body in found["scene"]["bodies"]:
        body["mass"] *= 2
    return json.dumps(found)


def other_tcp(path: Path) -> None:
    """A robot's description with the hand for its TCP."""
    told = json.loads(path.read_text())
    told["spec"]["tcp_link"] = told["spec"]["hand_link"]
    loose.write_json(path, told)


def exchanged_paths(dataset: Path) -> None:
    """Camera paths of the first two episodes, by their numbers."""
    loose.edit_cells(
        dataset, "demorec/camera_poses", "episode_index", lambda v: [{0: 1, 1: 0}.get(number, number) for number in v]
    )


def phases_late(phases: list[Entry]) -> list[Entry]:
    """All but the first begin ten frames later."""
    for before, phase in itertools.pairwise(phases):
        before["to"] += 10
        phase["from"] += 10
    return phases


def turned_mount(camera: Entry) -> Entry:
    """A camera whose mount is turned by 6 degrees about its z axis."""
    *place, x, y, z, w = camera["mount_from_camera"]
    c, s = np.cos(0.05), np.sin(0.05)
    turned_by = [c * x + s * y, c * y - s * x, c * z + s * w, c * w - s * z]
    return camera | {"mount_from_camera": [*place, *turned_by]}


def other_measure(checks: list[Entry]) -> list[Entry]:
    """The outcome's first condition has another value."""
    checks[0]["value"] += 0.003
    return checks
