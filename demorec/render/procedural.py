"""Procedural textures: pixels as a pure function of a `Texture`, bit-exact on every machine.

Only integer noise and triangle waves: NumPy's vectorised sines may differ in the last bit between CPUs.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.episode.scene import Texture


@functools.lru_cache(maxsize=32)
def texture_pixels(texture: Texture, size: int = 256) -> NDArray[np.uint8]:
    """Compute (size, size, 3) RGB pixels; the same array again for the same arguments."""
    axis = (np.arange(size) + 0.5) / size
    v, u = np.meshgrid(axis, axis, indexing="ij")
    mix = _mix(texture, u, v)[..., None]
    low, high = np.array(texture.colors[0]), np.array(texture.colors[1])
    return np.asarray(np.clip(255.0 * (low + (high - low) * mix) + 0.5, 0, 255).astype(np.uint8))


def _mix(texture: Texture, u: Array, v: Array) -> Array:
    """Compute each pixel's blend between the two colours, 0..1."""
    scale = texture.scale
    match texture.pattern:
        case "plain":
            return np.zeros_like(u)
        case "checker":
            return np.asarray((np.floor(u * scale) + np.floor(v * scale)) % 2, dtype=np.float64)
        case "stripes":
            return np.asarray(np.floor(u * scale) % 2, dtype=np.float64)
        case "noise":
            return _fractal(u * scale, v * scale, texture.seed)
        case "wood":
            # Rings of a trunk cut along its length: stretched noise, folded into bands.
            warp = _fractal(u * scale, v * scale * 0.2, texture.seed)
            bands = _triangle(4.0 * warp + 0.3 * scale * u)
            grain = _fractal(u * scale * 16.0, v * scale, texture.seed + 1)
            return np.asarray(0.75 * bands + 0.25 * grain, dtype=np.float64)


def _triangle(x: Array) -> Array:
    """Triangle wave of period 1 between 0 and 1."""
    return np.asarray(np.abs(2.0 * (x - np.floor(x)) - 1.0), dtype=np.float64)


def _fractal(x: Array, y: Array, seed: int) -> Array:
    """Sum of value noise over four octaves, 0..1."""
    total = np.zeros_like(x)
    weight, weights = 1.0, 0.0
    for octave in range(4):
        total = total + weight * _value_noise(x * 2**octave, y * 2**octave, seed + 1013 * octave)
        weights += weight
        weight *= 0.5
    return total / weights


def _value_noise(x: Array, y: Array, seed: int) -> Array:
    """Random values on a grid, smoothly interpolated, 0..1."""
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = x - x0, y - y0
    fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
    i, j = x0.astype(np.int64), y0.astype(np.int64)
    a, b = _hash(i, j, seed), _hash(i + 1, j, seed)
    c, d = _hash(i, j + 1, seed), _hash(i + 1, j + 1, seed)
    upper = a + fx * (b - a)
    lower = c + fx * (d - c)
    return np.asarray(upper + fy * (lower - upper), dtype=np.float64)


def _hash(i: NDArray[np.int64], j: NDArray[np.int64], seed: int) -> Array:
    """Hash each grid point to a number in 0..1 (the finaliser of MurmurHash3, 64 bits)."""
    offset = (0x165667B19E3779F9 * (seed + 1)) & (2**64 - 1)
    h = i.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + j.astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
    h = h + np.uint64(offset)
    h = (h ^ (h >> np.uint64(33))) * np.uint64(0xFF51AFD7ED558CCD)
    h = (h ^ (h >> np.uint64(33))) * np.uint64(0xC4CEB9FE1A85EC53)
    h = h ^ (h >> np.uint64(33))
    return np.asarray((h >> np.uint64(11)).astype(np.float64) / 2.0**53, dtype=np.float64)
