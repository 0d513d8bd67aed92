"""Faults in rows and images of LeRobot datasets, for `dataset_faults.py`.

The order is fixed: every second fault belongs to the half that was never looked at when laws were written.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyarrow as pa

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from support import loose
from support.dataset_edits import (
    FRONT,
    WRIST,
    Fault,
    alike,
    blurred,
    both,
    columns,
    exchanged,
    film,
    filtered,
    frozen,
    halved,
    late,
    middle,
    noisy,
    numbers,
    one,
    pixels,
    reframed,
    scaled,
    table,
)
from support.dataset_particular import (
    bar,
    blocks,
    exchanged_features,
    film_of_other,
    first_of_other,
    held,
    middle_all,
    normalised,
    repeats,
    spot,
    turned,
)

STATE, VELOCITY, EFFORT, POSE = (f"observation.{name}" for name in ("state", "velocity", "effort", "ee_pose"))
ACTION, WORLD, EPISODES, KNOWN = "action", "observation.environment_state", "meta/episodes", "demorec/episodes"

NUMBERS: tuple[tuple[str, Fault], ...] = (
    ("velocities in degrees", numbers(VELOCITY, np.degrees)),
    ("velocities three frames late", numbers(VELOCITY, lambda r: late(r, 3))),
    ("velocities of two joints exchanged", numbers(VELOCITY, lambda r: exchanged(r, 1, 3))),
    ("velocities are zeros", numbers(VELOCITY, np.zeros_like)),
    ("velocity of a joint inverted", numbers(VELOCITY, lambda r: columns(r, 2, np.negative))),
    ("velocities of another episode", lambda d: loose.put_rows(d, VELOCITY, loose.rows_of(d, VELOCITY)[::-1])),
    ("efforts are zeros", numbers(EFFORT, np.zeros_like)),
    ("efforts in Nmm", numbers(EFFORT, lambda r: 1000 * r)),
    ("efforts of two joints exchanged", numbers(EFFORT, lambda r: exchanged(r, 1, 3))),
    ("efforts five frames late", numbers(EFFORT, lambda r: late(r, 5))),
    ("efforts with the other sign", numbers(EFFORT, np.negative)),
    ("pose in mm", numbers(POSE, lambda r: columns(r, slice(3), lambda v: 1000 * v))),
    ("pose with conjugate quaternions", numbers(POSE, lambda r: columns(r, slice(3, 6), np.negative))),
    ("pose of the flange", numbers(POSE, lambda r: columns(r, 2, lambda v: v + 0.1))),
    ("pose four frames late", numbers(POSE, lambda r: late(r, 4))),
    ("pose of another episode", lambda d: loose.put_rows(d, POSE, np.roll(loose.rows_of(d, POSE), 97, axis=0))),
    ("quaternions not of unit length", numbers(POSE, lambda r: columns(r, slice(3, 7), lambda v: 1.1 * v))),
    ("quaternions that change their sign", numbers(POSE, lambda r: middle_all(r, slice(3, 7), -1.0))),
    ("pose with x and y exchanged", numbers(POSE, lambda r: exchanged(r, 0, 1))),
    ("state of a joint in degrees", numbers(STATE, lambda r: columns(r, 2, np.degrees))),
    ("state of a joint off by a turn from the middle on", numbers(STATE, lambda r: columns(r, 4, turned))),
    ("state of two joints exchanged", numbers(STATE, lambda r: exchanged(r, 1, 2))),
    (
        "joints exchanged in state and action of one episode",
        alike(lambda r: exchanged(r, 1, 3), STATE, ACTION, only=(1,)),
    ),
    ("state resampled by interpolation", numbers(STATE, halved)),
    ("state of half the rate, held", numbers(STATE, lambda r: held(r, 2))),
    ("a spike in the state", numbers(STATE, lambda r: middle(r, 1, r.max(axis=0)), only=(1,))),
    ("a joint that stands still for a second", numbers(STATE, lambda r: columns(r, 1, lambda v: frozen(v, 20, 20)))),
    ("gripper in 0 to 1 in the state", numbers(STATE, lambda r: columns(r, -1, lambda v: v / max(v.max(), 1e-9)))),
    ("gripper in 0 to 100 in state and action", alike(lambda r: columns(r, -1, lambda v: 1000 * v), STATE, ACTION)),
    ("gripper inverted in the state", numbers(STATE, lambda r: columns(r, -1, lambda v: v.max() - v))),
    ("gripper inverted in the action", numbers(ACTION, lambda r: columns(r, -1, lambda v: v.max() - v))),
    ("gripper's action always open", numbers(ACTION, lambda r: columns(r, -1, lambda v: 0 * v + v.max()))),
    ("actions ten frames late", numbers(ACTION, lambda r: late(r, 10))),
    ("actions ten frames early", numbers(ACTION, lambda r: late(r, -10))),
    ("actions of one episode are zeros", numbers(ACTION, np.zeros_like, only=(1,))),
    ("actions clipped at half their size", numbers(ACTION, lambda r: np.clip(r, r.min(0) / 2, r.max(0) / 2))),
    ("actions twice as large", numbers(ACTION, lambda r: 2 * r)),
    ("actions normalised to -1 to 1", numbers(ACTION, normalised)),
    ("actions with columns rolled", numbers(ACTION, lambda r: np.roll(r, 1, axis=1))),
    ("actions of another episode", lambda d: loose.put_rows(d, ACTION, np.roll(loose.rows_of(d, ACTION), 83, axis=0))),
    ("actions summed up", numbers(ACTION, lambda r: np.cumsum(r, axis=0))),
    ("actions as differences of actions", numbers(ACTION, lambda r: np.diff(r, axis=0, prepend=r[:1]))),
    ("actions rounded to two decimals", numbers(ACTION, lambda r: np.round(r, 2))),
    ("actions of the arm with the other sign", numbers(ACTION, lambda r: columns(r, slice(0, -1), np.negative))),
    ("actions filtered", numbers(ACTION, filtered)),
    ("actions with noise", numbers(ACTION, lambda r: r + 0.3 * r.std(axis=0) * noisy(1.0)(0 * r))),
    ("actions of the first arm joint only", numbers(ACTION, lambda r: columns(r, slice(1, -1), np.zeros_like))),
    ("objects in mm", numbers(WORLD, lambda r: 1000 * r)),
    ("objects never move", numbers(WORLD, lambda r: 0 * r + r[:1])),
    ("objects of another episode", lambda d: loose.put_rows(d, WORLD, loose.rows_of(d, WORLD)[::-1])),
    (
        "all numbers of one episode backwards",
        alike(lambda r: r[::-1], STATE, VELOCITY, EFFORT, POSE, ACTION, only=(1,)),
    ),
    ("noise in the state", numbers(STATE, noisy(0.02))),
    ("state filtered", numbers(STATE, filtered)),
    ("zeros for lost rows", numbers(STATE, lambda r: middle(r, 5, 0.0), only=(1,))),
    (
        "zeros for lost rows in all numbers",
        alike(lambda r: middle(r, 5, 0.0), STATE, VELOCITY, EFFORT, POSE, ACTION, only=(1,)),
    ),
    ("lost rows held", alike(lambda r: frozen(r, len(r) // 3, 8), STATE, VELOCITY, EFFORT, POSE, ACTION, only=(1,))),
    ("every fifth row repeats the one before", alike(lambda r: repeats(r, 5), STATE, VELOCITY, EFFORT, POSE, ACTION)),
    ("state and action exchanged", exchanged_features(STATE, ACTION)),
    ("state late by five frames", numbers(STATE, lambda r: late(r, 5))),
    ("state of the next row", numbers(STATE, lambda r: late(r, -1))),
    ("a joint's zero moved in one episode", numbers(STATE, lambda r: columns(r, 1, lambda v: v + 0.15), only=(1,))),
    ("state and pose of one episode are zeros", alike(np.zeros_like, STATE, POSE, only=(2,))),
)

ROWS: tuple[tuple[str, Fault], ...] = (
    ("each row twice", reframed(lambda parts, fps: [np.repeat(p, 2) for p in parts])),
    ("each row twice in one episode", one(lambda p, fps: np.repeat(p, 2))),
    ("every second row of one episode", one(lambda p, fps: p[::2])),
    ("a second is missing", one(lambda p, fps: np.delete(p, np.s_[len(p) // 3 : len(p) // 3 + fps]))),
    ("two episodes in one", reframed(lambda parts, fps: [np.concatenate(parts[:2]), *parts[2:]])),
    (
        "one episode in two",
        reframed(
            lambda parts, fps: [p[: len(p) // 2] for p in parts[:1]] + [parts[0][len(parts[0]) // 2 :], *parts[1:]]
        ),
    ),
    ("the last third is missing", one(lambda p, fps: p[: 2 * len(p) // 3])),
    ("the first third is missing", one(lambda p, fps: p[len(p) // 3 :])),
    ("two seconds of the last row", one(lambda p, fps: np.concatenate([p, np.repeat(p[-1:], 2 * fps)]))),
    ("two seconds of the first row", one(lambda p, fps: np.concatenate([np.repeat(p[:1], 2 * fps), p]))),
    ("an episode of one row", one(lambda p, fps: p[:1])),
    ("rows of an episode shuffled", one(lambda p, fps: np.random.default_rng(0).permutation(p))),
    ("an episode backwards", one(lambda p, fps: p[::-1])),
    ("a piece of an episode twice", one(lambda p, fps: np.concatenate([p[: len(p) // 2], p[len(p) // 3 :]]))),
    (
        "end of another episode",
        reframed(
            lambda parts, fps: [
                parts[0],
                np.concatenate([parts[1][: len(parts[1]) // 2], parts[2][len(parts[2]) // 2 :]]),
                *parts[2:],
            ]
        ),
    ),
    ("an episode twice, a row shorter", reframed(lambda parts, fps: [parts[0], parts[0][:-1], *parts[2:]])),
    ("every tenth row is missing", one(lambda p, fps: np.delete(p, np.s_[5::10]))),
    ("a few rows twice", one(lambda p, fps: np.sort(np.concatenate([p, p[len(p) // 4 :: len(p) // 4]])))),
    ("reward in all rows", numbers("next.reward", np.ones_like)),
    ("never a reward", numbers("next.reward", np.zeros_like)),
    ("reward a second early", numbers("next.reward", lambda r: late(r, -10))),
    ("never done", numbers("next.done", np.zeros_like)),
    ("done a row late", lambda d: loose.put_rows(d, "next.done", np.roll(loose.rows_of(d, "next.done"), 1))),
    ("success in all rows", numbers("next.success", np.ones_like)),
    ("success without reward", numbers("next.success", np.zeros_like)),
    ("times of a slow clock", numbers("timestamp", lambda r: 1.02 * r)),
    ("times that begin with the second frame", numbers("timestamp", lambda r: r + r[1])),
    ("times that jitter", numbers("timestamp", lambda r: r + 0.2 * r[1] * noisy(1.0)(0 * r))),
    ("times in ms", numbers("timestamp", lambda r: 1000 * r)),
    ("times rounded", numbers("timestamp", lambda r: np.round(r, 1))),
    (
        "times of the whole dataset",
        lambda d: loose.put_rows(d, "timestamp", np.arange(len(loose.rows_of(d, "index"))) / loose.info_of(d)["fps"]),
    ),
    ("frames counted from 1", numbers("frame_index", lambda r: r + 1)),
    ("episodes counted from 1", numbers("episode_index", lambda r: r + 1)),
    ("rows counted anew in each episode", numbers("index", lambda r: r - r[0])),
    ("one task for all", numbers("task_index", np.zeros_like)),
    (
        "tasks exchanged",
        lambda d: loose.put_rows(
            d, "task_index", loose.rows_of(d, "task_index").max() - loose.rows_of(d, "task_index")
        ),
    ),
    ("another task from the middle on", numbers("task_index", lambda r: middle(r, 10**6, 1 - min(r[0], 1)), only=(0,))),
    ("rows of two episodes exchanged", table("data", lambda t: t.take(pa.array(np.roll(np.arange(t.num_rows), 40))))),
    ("the last row is missing", table("data", lambda t: t.slice(0, t.num_rows - 1))),
)

VIDEOS: tuple[tuple[str, Fault], ...] = (
    ("BGR", film(FRONT, lambda r: r[..., ::-1], only=None)),
    ("BGR in one episode", film(WRIST, lambda r: r[..., ::-1])),
    ("mirrored in one episode", film(FRONT, lambda r: r[:, :, ::-1])),
    ("upside down in one episode", film(WRIST, lambda r: r[:, ::-1, ::-1])),
    ("turned by 90 degrees in one episode", film(WRIST, lambda r: np.rot90(r, axes=(1, 2)))),
    ("images of another episode", film_of_other),
    ("five frames late in one episode", film(FRONT, lambda r: late(r, 5))),
    ("a second early in one episode", film(FRONT, lambda r: late(r, -len(r) // 8))),
    (
        "one image lost in one episode",
        film(WRIST, lambda r: np.concatenate([np.delete(r, len(r) // 4, axis=0), r[-1:]])),
    ),
    (
        "ten images lost in one episode",
        film(
            WRIST,
            lambda r: np.concatenate(
                [np.delete(r, np.s_[len(r) // 4 : len(r) // 4 + 10], axis=0), np.repeat(r[-1:], 10, axis=0)]
            ),
        ),
    ),
    ("frozen from the middle on", film(FRONT, lambda r: frozen(r, len(r) // 2, len(r)))),
    ("frozen for a second", film(WRIST, lambda r: frozen(r, len(r) // 4, max(len(r) // 8, 8)))),
    ("a tenth repeats the one before", film(WRIST, lambda r: repeats(r, 10), only=None)),
    ("each image twice", film(FRONT, lambda r: held(r, 2), only=None)),
    ("interpolated", film(FRONT, lambda r: halved(r.astype(np.float32)), only=None)),
    ("black in one episode", film(FRONT, np.zeros_like)),
    ("cameras exchanged in one episode", both(lambda a, b: (b, a))),
    (
        "cameras exchanged from the middle on",
        both(
            lambda a, b: (
                np.concatenate([a[: len(a) // 2], b[len(a) // 2 :]]),
                np.concatenate([b[: len(a) // 2], a[len(a) // 2 :]]),
            )
        ),
    ),
    ("one camera twice in one episode", both(lambda a, b: (a, a))),
    ("squeezed in one episode", film(FRONT, lambda r: scaled(r, 0.75, 1.0))),
    ("zoomed in one episode", film(FRONT, lambda r: scaled(r, 1.3, 1.3))),
    ("shifted by 4 px in one episode", film(FRONT, lambda r: np.roll(r, 4, axis=2))),
    ("darker in one episode", film(FRONT, pixels(lambda r: 0.7 * r))),
    ("gray in one episode", film(FRONT, pixels(lambda r: np.repeat(r.mean(axis=3, keepdims=True), 3, axis=3)))),
    ("noise", film(FRONT, pixels(noisy(12.0)), only=None)),
    ("blurred in one episode", film(WRIST, blurred)),
    ("squeezed by the coder", film(FRONT, lambda r: r, only=None, crf=45)),
    ("green blocks", film(FRONT, blocks)),
    ("a white image", film(WRIST, lambda r: middle(r, 1, 255))),
    ("an image of noise", film(FRONT, lambda r: middle(r, 1, np.random.default_rng(0).integers(0, 255, r.shape[1:])))),
    ("gamma twice in one episode", film(FRONT, pixels(lambda r: 255 * (r / 255) ** 0.45))),
    ("narrow range taken for full", film(WRIST, pixels(lambda r: 16 + 219 / 255 * r))),
    ("backwards in one episode", film(FRONT, lambda r: r[::-1])),
    ("coded at another rate", film(FRONT, lambda r: r, only=None, rate=24)),
    ("noise for images in one episode", film(WRIST, lambda r: np.random.default_rng(0).integers(0, 255, r.shape))),
    ("a spot on the lens from one episode on", film(FRONT, spot, only=(1, 2, 3, 4, 5))),
    ("the first second of one episode is the end of the one before", first_of_other),
    ("a bar of black below", film(FRONT, bar, only=None)),
)
