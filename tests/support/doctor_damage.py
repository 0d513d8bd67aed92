"""Damage the rows and images of a dataset before it is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from support.doctor_bases import WRIST, DatasetBase, DemoDataset, DemoEpisode, Images, record
from support.doctor_motion import Array

Pixels = NDArray[np.uint8]
RowFault = Callable[[DemoDataset, int], None]


def copied(dataset: DemoDataset) -> DemoDataset:
    """A deep copy of the rows, with the same images."""
    episodes = [
        replace(episode, columns={n: v.copy() for n, v in episode.columns.items()}, time_s=episode.time_s.copy(),
                images=dict(episode.images))
        for episode in dataset.episodes
    ]  # fmt: skip
    return replace(dataset, episodes=episodes)


def _kept(episode: DemoEpisode, rows: NDArray[np.int64]) -> None:
    """Keep or repeat rows of an episode, with their images and timestamps."""
    episode.columns = {name: values[rows] for name, values in episode.columns.items()}
    episode.time_s = episode.time_s[rows]
    episode.images = {camera: _changed(draw, lambda shown: shown[rows]) for camera, draw in episode.images.items()}


def _changed(draw: Images, change: Callable[[Pixels], Pixels]) -> Images:
    return lambda: np.ascontiguousarray(change(draw()))


def _regular(dataset: DemoDataset, episode: DemoEpisode) -> None:
    episode.time_s = np.arange(len(episode.time_s)) / dataset.base.fps


def on(feature: str, change: Callable[[Array, DatasetBase], Array], *, whole: bool = False) -> RowFault:
    """Change the state, the action or another feature, in one episode or in all."""

    def spoil(episode: DemoEpisode, base: DatasetBase) -> None:
        name = base.feature(feature)
        before = episode.columns[name].copy()
        episode.columns[name] = change(before.copy(), base)
        assert not np.array_equal(before, episode.columns[name], equal_nan=True), f"{name} was not changed"

    return _each(spoil, whole)


def _each(spoil: Callable[[DemoEpisode, DatasetBase], None], whole: bool) -> RowFault:
    """Spoil one episode, or all."""

    def spoil_dataset(dataset: DemoDataset, number: int) -> None:
        for episode in dataset.episodes if whole else [dataset.episodes[number]]:
            spoil(episode, dataset.base)

    return spoil_dataset


def both(change: Callable[[Array, DatasetBase], Array]) -> RowFault:
    def spoil(dataset: DemoDataset, number: int) -> None:
        for feature in ("state", "action"):
            on(feature, change)(dataset, number)

    return spoil


def time(change: Callable[[Array], Array], *, whole: bool = False) -> RowFault:
    def spoil(episode: DemoEpisode, base: DatasetBase) -> None:
        episode.time_s = change(episode.time_s)

    return _each(spoil, whole)


def put(value: float, rows: slice, element: int = 1) -> Callable[[Array, DatasetBase], Array]:
    def change(values: Array, base: DatasetBase) -> Array:
        values[rows, element] = value
        return values

    return change


def _is_degrees(base: DatasetBase) -> bool:
    return base.name in ("degrees", "openpi")


def other_unit(values: Array, base: DatasetBase) -> Array:
    """Convert degrees to radians and back, -100..100 to encoder ticks, and metres to millimetres."""
    joints = slice(0, -1)
    if base.is_delta:
        values[:, :3] *= 1000
    elif base.name == "normalised":
        values[:, joints] = np.round(2048 + values[:, joints] * 12)
    else:
        values[:, joints] *= np.pi / 180 if _is_degrees(base) else 180 / np.pi
    return values


def spiked(values: Array, base: DatasetBase) -> Array:
    values[len(values) // 2, 1] += 1.5 * np.ptp(values[:, 1])
    return values


def slipped(values: Array, base: DatasetBase) -> Array:
    values[len(values) // 2 :, 1] += 0.5 * np.ptp(values[:, 1])
    return values


def beyond(values: Array, base: DatasetBase) -> Array:
    """Move smoothly to a value that no joint has, for half a second."""
    peak = 5.0 if base.is_delta else 8.0 if not (_is_degrees(base) or base.name == "normalised") else 420.0
    bump = np.exp(-0.5 * ((np.arange(len(values)) - len(values) / 2) / (0.25 * base.fps)) ** 2)
    values[:, 1] += peak * bump
    return values


def shifted(seconds: float, *, frames: int = 0) -> Callable[[Array, DatasetBase], Array]:
    """Shift rows later by some time and some frames; earlier if negative."""

    def change(values: Array, base: DatasetBase) -> Array:
        later = round(seconds * base.fps) + frames
        found: Array = values[np.clip(np.arange(len(values)) - later, 0, len(values) - 1)]
        return found

    return change


def held(values: Array, base: DatasetBase) -> Array:
    found: Array = values[np.arange(len(values)) // 4 * 4]
    return found


def stuck(values: Array, base: DatasetBase) -> Array:
    begin = len(values) // 3
    values[begin : begin + round(1.5 * base.fps)] = values[begin]
    return values


def exchanged(values: Array, base: DatasetBase) -> Array:
    values[:, [0, 1]] = values[:, [1, 0]]
    return values


def gripper(side: int, change: Callable[[Array], Array | float]) -> Callable[[Array, DatasetBase], Array]:
    """Change the gripper of the state (0) or of the action (1)."""

    def spoil(values: Array, base: DatasetBase) -> Array:
        values[:, base.grippers[side]] = change(values[:, base.grippers[side]])
        return values

    return spoil


def turned_round(grip: Array) -> Array:
    found: Array = grip.max() + grip.min() - grip
    return found


def quaternion_flips(values: Array, base: DatasetBase) -> Array:
    values[len(values) // 3 : len(values) // 2, 3:7] *= -1
    return values


def equal_to_state(*, whole: bool) -> RowFault:
    return _each(lambda episode, base: episode.columns.update({base.action: episode.columns[base.state].copy()}), whole)


def _fastest(state: Array, length: int) -> NDArray[np.int64]:
    """Find the consecutive rows, of the given number, that contain the fastest motion."""
    moved = np.abs(state[length:, :-1] - state[:-length, :-1]) / np.maximum(np.ptp(state[:, :-1], axis=0), 1e-6)
    return int(np.argmax(moved.max(1))) + np.arange(length)


def dropped_rows(*, regular: bool) -> RowFault:
    """Drop the fastest 0.6 s of motion, or single rows at many places."""

    def spoil(dataset: DemoDataset, number: int) -> None:
        episode = dataset.episodes[number]
        rows = np.arange(len(episode.time_s))
        lost = (
            _fastest(episode.columns[dataset.base.state], round(0.6 * dataset.base.fps)) if regular else rows[10:-10:9]
        )
        _kept(episode, np.setdiff1d(rows, lost))
        if regular:
            _regular(dataset, episode)

    return spoil


def idle(place: float, seconds: float) -> RowFault:
    """Insert a rest at a point of the episode, 0 to 1, as by an inactive operator; sensors keep their noise."""

    def spoil(dataset: DemoDataset, number: int) -> None:
        episode = dataset.episodes[number]
        rows = np.arange(len(episode.time_s))
        at = int(place * (len(rows) - 1))
        rest = np.full(round(seconds * dataset.base.fps), at)
        rows = np.concatenate([rows[: at + 1], rest, rows[at + 1 :]])
        _kept(episode, rows)
        episode.images = {camera: _changed(draw, _noisy) for camera, draw in episode.images.items()}
        noise = np.random.default_rng(0).normal(0, dataset.base.arms[0].noise, (len(rest), 3))
        if not dataset.base.arms[0].tick[0]:
            episode.columns[dataset.base.state][at + 1 : at + 1 + len(rest), :3] += noise
        if dataset.base.is_delta:
            episode.columns[dataset.base.action][at + 1 : at + 1 + len(rest), :-1] = 0
        _regular(dataset, episode)

    return spoil


def _noisy(images: Pixels) -> Pixels:
    noise = np.random.default_rng(0).integers(-2, 3, images.shape)
    return np.clip(images + noise, 0, 255).astype(np.uint8)


def spoilt(kind: str) -> RowFault:
    def spoil(dataset: DemoDataset, number: int) -> None:
        has_cameras = bool(dataset.episodes[number].images)
        made = record(dataset.base, dataset.seed, number + 1, spoilt={number: kind}, cameras=has_cameras)
        dataset.episodes[number] = made.episodes[number]

    return spoil


def copies(*others: int) -> RowFault:
    def spoil(dataset: DemoDataset, number: int) -> None:
        for other in (number + step for step in others):
            dataset.episodes[other] = replace(dataset.episodes[number])

    return spoil


def shared_piece(dataset: DemoDataset, number: int) -> None:
    part = replace(dataset.episodes[number - 1])
    _kept(part, np.arange(len(part.time_s) * 3 // 10, len(part.time_s)))
    _regular(dataset, part)
    dataset.episodes[number] = part


def two_in_one(dataset: DemoDataset, number: int) -> None:
    first, second = dataset.episodes[number], dataset.episodes[number - 2]
    first.columns = {n: np.concatenate([v, second.columns[n]]) for n, v in first.columns.items()}
    first.time_s = np.arange(len(first.time_s) + len(second.time_s)) / dataset.base.fps
    first.images = {camera: _joined(draw, second.images[camera]) for camera, draw in first.images.items()}


def _joined(first: Images, second: Images) -> Images:
    return lambda: np.concatenate([first(), second()])


def task(text: str) -> RowFault:
    return lambda dataset, number: setattr(dataset.episodes[number], "task", text)


def shown(change: Callable[[Pixels], Pixels], *, whole: bool = False) -> RowFault:
    """Change the images of the last camera."""

    def spoil(episode: DemoEpisode, base: DatasetBase) -> None:
        episode.images[base.cameras[-1]] = _changed(episode.images[base.cameras[-1]], change)

    return _each(spoil, whole)


def third_rate(images: Pixels) -> Pixels:
    found: Pixels = images[np.arange(len(images)) // 3 * 3]
    return found


def late(images: Pixels) -> Pixels:
    found: Pixels = images[np.maximum(np.arange(len(images)) - len(images) // 6, 0)]
    return found


def covered(images: Pixels) -> Pixels:
    """Dark images with noise and little contrast, as with a hand over the lens."""
    noise = np.random.default_rng(0).normal(0, 2, images.shape)
    return np.clip(25 + 0.02 * images + noise, 0, 255).astype(np.uint8)


def frozen(share: float) -> Callable[[Pixels], Pixels]:
    def change(images: Pixels) -> Pixels:
        begin = int(0.4 * (1 - share) * len(images))
        images[begin : begin + int(share * len(images))] = images[begin]
        return images

    return change


def exchange_cameras(dataset: DemoDataset, number: int) -> None:
    images = dataset.episodes[number].images
    dataset.episodes[number].images = dict(zip(images, reversed(images.values()), strict=True))


def double_camera(*, whole: bool) -> RowFault:
    return _each(lambda episode, base: episode.images.update({WRIST: episode.images[base.cameras[0]]}), whole)


def other_take(dataset: DemoDataset, number: int) -> None:
    episode, other = dataset.episodes[number], dataset.episodes[number - 1]
    rows = np.minimum(np.arange(len(episode.time_s)), len(other.time_s) - 1)
    episode.images = {camera: _changed(draw, lambda shown: shown[rows]) for camera, draw in other.images.items()}


def other_action(dataset: DemoDataset, number: int) -> None:
    """The action of the previous episode, stretched to the length of this one."""
    episode, other = dataset.episodes[number], dataset.episodes[number - 1]
    rows = np.linspace(0, len(other.time_s) - 1, len(episode.time_s)).astype(int)
    name = dataset.base.feature("action")
    episode.columns[name] = other.columns[name][rows]
