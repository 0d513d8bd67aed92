"""Images of a demonstration by two cameras, drawn with NumPy: an arm over a textured table, with sensor noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from support.doctor_motion import ArmModel, Array, Motion

HEIGHT, WIDTH = 72, 96
Image = NDArray[np.float32]
_ROWS, _COLUMNS = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Shot:
    """A motion on the table with number `table`, and the seed of the sensor noise."""

    motion: Motion
    arm: ArmModel
    table: int
    seed: int


@lru_cache(maxsize=8)
def _table(number: int) -> Image:
    """(300, 400, 3) wooden table with stains."""
    rng = np.random.default_rng(number)
    rows, columns = np.mgrid[0:300, 0:400]
    grain = np.sin(rows / rng.uniform(3, 6) + 4 * np.sin(columns / 60)) * 6 + rng.normal(0, 5, (300, 400))
    texture = rng.uniform(90, 170, 3) + grain[..., None] * (1, 0.9, 0.7)
    for row, column, radius in zip(
        rng.integers(0, 300, 40), rng.integers(0, 400, 40), rng.integers(4, 18, 40), strict=True
    ):
        texture[(rows - row) ** 2 + (columns - column) ** 2 < radius**2] += rng.uniform(-35, 35, 3)
    found: Image = texture.astype(np.float32)
    return found


def _line(image: Image, start: Array, end: Array, width: float, color: tuple[int, int, int]) -> None:
    """Draw a thick line between two points (column, row) in place."""
    low, high = np.minimum(start, end) - width, np.maximum(start, end) + width
    near = tuple(slice(max(0, int(low[axis])), max(0, int(high[axis]) + 2)) for axis in (1, 0))
    along = (end - start).astype(np.float32)
    columns, rows = _COLUMNS[near] - start[0], _ROWS[near] - start[1]
    u = np.clip((columns * along[0] + rows * along[1]) / (float(along @ along) + 1e-6), 0, 1)
    away = (columns - u * along[0]) ** 2 + (rows - u * along[1]) ** 2
    inside = away < width**2
    image[near][inside] = np.array(color, np.float32) * (1.05 - 0.4 * away[inside, None] / width**2)


def _block(image: Image, center: Array, half: float, color: tuple[int, int, int]) -> None:
    left, top = (max(0, round(float(value) - half)) for value in center)
    image[top : max(0, round(float(center[1]) + half)), left : max(0, round(float(center[0]) + half))] = color


def _developed(images: Image, seed: int) -> NDArray[np.uint8]:
    """(T, H, W, 3) images with sensor noise and a slightly unsteady exposure."""
    rng = np.random.default_rng(seed)
    bank = rng.normal(0, 2.5, HEIGHT * WIDTH * 3 + 5000).astype(np.float32)
    for image, begin in zip(images, rng.integers(0, 5000, len(images)), strict=True):
        image *= rng.normal(1, 0.004)
        image += bank[begin : begin + image.size].reshape(image.shape)
    return np.clip(images, 0, 255).astype(np.uint8)


def _seen(shot: Shot) -> tuple[Array, Array, Array]:
    """Image positions of hand and object, and the gripper's opening from 0 to 1, a frame late as with cameras."""
    late = np.maximum(np.arange(len(shot.motion.true)) - 1, 0)
    opened, closed, _ = shot.arm.grip
    opening = (shot.motion.true[late, -1] - closed) / (opened - closed)
    return shot.arm.place(shot.motion.true[late, :-1]), shot.motion.thing[late], opening


def front_camera(shot: Shot) -> NDArray[np.uint8]:
    """(T, H, W, 3) images of the arm from the front."""
    hands, things, openings = _seen(shot)

    def pixel(place: Array) -> Array:
        found: Array = np.array([48 + 30 * place[0], 46 - 16 * place[1] - 22 * place[2]])
        return found

    images = np.repeat(_table(shot.table)[None, :HEIGHT, :WIDTH], len(hands), axis=0)
    for image, hand, thing, opening in zip(images, hands, things, openings, strict=True):
        _block(image, pixel(np.array([-0.6, 0.5, 0])), 8, (215, 215, 225))
        _block(image, pixel(thing), 4, (190, 45, 40))
        base, tip = np.array([48.0, 74.0]), pixel(hand)
        elbow = (base + tip) / 2 + (13, -9)
        _line(image, base, elbow, 4.5, (235, 190, 60))
        _line(image, elbow, tip, 3.5, (235, 190, 60))
        for side in (-1, 1):
            _line(image, tip, tip + np.array([side * (1.5 + 3 * opening), 7]), 1.4, (40, 40, 45))
    return _developed(images, shot.seed)


def wrist_camera(shot: Shot) -> NDArray[np.uint8]:
    """(T, H, W, 3) images of the table below the hand, with the fingers in front."""
    hands, things, openings = _seen(shot)
    table = _table(shot.table)
    images = np.empty((len(hands), HEIGHT, WIDTH, 3), np.float32)
    for image, hand, thing, opening in zip(images, hands, things, openings, strict=True):
        row, column = int(np.clip(100 - 60 * hand[1], 0, 227)), int(np.clip(136 + 80 * hand[0], 0, 303))
        image[:] = table[row : row + HEIGHT, column : column + WIDTH]
        away = (thing - hand)[:2] * (80, -60)
        _block(image, np.array([48.0, 45.0]) + away, 7 / (0.7 + max(0.0, float(hand[2]))), (190, 45, 40))
        for side in (-1, 1):
            _line(
                image, np.array([48.0 + side * 20, 76]), np.array([48 + side * (4 + 11 * opening), 50]), 4, (40, 40, 45)
            )
    return _developed(images, shot.seed + 1)
