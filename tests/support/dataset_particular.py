"""Particular faults of LeRobot datasets, made of the changes of `dataset_edits.py`."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from support import loose
from support.dataset_edits import (
    FRONT,
    WRIST,
    Entry,
    Fault,
    at,
    stats,
    swap,
)
from support.loose import Rows


def middle_all(rows: Rows, chosen: Any, factor: float) -> Rows:
    """Some columns times a factor, from the middle on."""
    rows[len(rows) // 2 :, chosen] *= factor
    return rows


def turned(rows: Rows) -> Rows:
    """A turn more from the middle on."""
    return np.asarray(rows + 2 * np.pi * (np.arange(len(rows)) >= len(rows) // 2))


def held(rows: Rows, times: int) -> Rows:
    """Each value so many times, at the same length."""
    return np.asarray(rows[np.arange(len(rows)) // times * times])


def repeats(rows: Rows, every: int) -> Rows:
    """Some rows repeat the one before."""
    rows[every::every] = rows[every - 1 : -1 : every][: len(rows[every::every])]
    return rows


def normalised(rows: Rows) -> Rows:
    """Each column in -1 to 1."""
    return np.asarray(2 * (rows - rows.min(axis=0)) / np.maximum(np.ptp(rows, axis=0), 1e-9) - 1)


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
        loose.edit_table(dataset, "meta/episodes", partial(loose.replaced, name=name, values=values))


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
    for body in found["simulation"]["scene"]["bodies"]:
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
