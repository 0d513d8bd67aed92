"""Faults of LeRobot datasets as functions of their folder, made of changes of rows, images, tables and files."""

from __future__ import annotations

import hashlib
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

    def fault(dataset: Path) -> None:
        for name in names:
            numbers(name, change, only=only)(dataset)

    return fault


def reframed(pick: Callable[[list[Rows], int], list[Rows]]) -> Fault:
    """Other rows, with their images."""

    def fault(dataset: Path) -> None:
        parts = [np.arange(part.start, part.stop) for part in loose.parts_of(dataset)]
        loose.reframe(dataset, pick(parts, loose.info_of(dataset)["fps"]))

    return fault


def one(change: Callable[[Rows, int], Rows]) -> Fault:
    """Other rows of the second episode."""
    return reframed(lambda parts, fps: [parts[0], change(parts[1], fps), *parts[2:]])


def film(
    camera: str, change: Change, *, only: Sequence[int] | None = (1,), rate: int | None = None, crf: int = 18
) -> Fault:
    """Other images in some episodes; None: in all."""

    def fault(dataset: Path) -> None:
        images = loose.images_of(dataset, camera)
        for number, part in enumerate(loose.parts_of(dataset)):
            if only is None or number in only:
                images[part] = np.clip(change(images[part].copy()), 0, 255)
        loose.put_images(dataset, camera, images, rate=rate, crf=crf)

    return fault


def both(change: Callable[[Rows, Rows], tuple[Rows, Rows]]) -> Fault:
    """Other images of both cameras in the second episode."""

    def fault(dataset: Path) -> None:
        a, b, part = *(loose.images_of(dataset, name) for name in (FRONT, WRIST)), loose.parts_of(dataset)[1]
        a[part], b[part] = change(a[part].copy(), b[part].copy())
        loose.put_images(dataset, FRONT, a)
        loose.put_images(dataset, WRIST, b)

    return fault


def cells(place: str, names: str | Sequence[str], change: Callable[[list[Any]], list[Any]]) -> Fault:
    """Other values of a table's columns."""

    def fault(dataset: Path) -> None:
        for name in [names] if isinstance(names, str) else names:
            loose.edit_cells(dataset, place, name, change)

    return fault


def table(place: str, change: loose.Table) -> Fault:
    """Another table."""
    return lambda dataset: loose.edit_table(dataset, place, change)


def of_json(place: str, change: Callable[[Any], object]) -> Fault:
    """Another JSON file."""
    return lambda dataset: edit_json(dataset / place, change)


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
    moved = [out[:, y : y + h, x : x + w] for y in range(5) for x in range(5)]
    return np.asarray(np.mean(moved, axis=0), dtype=np.uint8)


def noisy(scale: float) -> Change:
    """Noise of numbers."""
    return lambda rows: rows + np.random.default_rng(0).normal(0, scale, rows.shape)
