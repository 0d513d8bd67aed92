"""Textures as mip pyramids, and palettes turned into face colours."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from demorec.core.errors import RenderError, describe_error
from demorec.render.raster.kernels.layout import MIP_LEVELS
from demorec.render.raster.mesh import Floats, RasterMesh, face_normals

LARGEST_SIDE = 1 << (MIP_LEVELS - 1)
Pixels = NDArray[np.uint8]


def load_image(path: Path) -> Pixels:
    """Read (H, W, 3) uint8 RGB of an image file; RenderError names the file if that fails."""
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except UnidentifiedImageError as error:
        raise RenderError(f"The texture is not a readable image: {path}") from error
    except OSError as error:
        raise RenderError(f"The texture cannot be read ({describe_error(error)}): {path}") from error


@functools.lru_cache(maxsize=32)
def pyramid(shape: tuple[int, ...], pixels: bytes) -> tuple[list[NDArray[np.uint32]], int]:
    """Compute an image's packed texels of each level, from the largest, and log2 of the largest level's side.

    Each level is square with a power of two as side, and repeats its first row and column at the end, so that a
    bilinear lookup needs no second wrap.
    """
    side = min(LARGEST_SIDE, 1 << max(0, math.ceil(math.log2(max(shape[:2])))))
    whole = Image.fromarray(np.frombuffer(pixels, dtype=np.uint8).reshape(shape))
    image = whole.resize((side, side), Image.Resampling.BOX)
    levels: list[NDArray[np.uint32]] = []
    log2_side = side.bit_length() - 1
    for level in range(log2_side + 1):
        small = image.resize((side >> level, side >> level), Image.Resampling.BOX)
        padded = np.pad(np.asarray(small), ((0, 1), (0, 1), (0, 0)), "wrap").reshape(-1, 3).astype(np.uint32)
        red, green, blue = padded[:, 0], padded[:, 1], padded[:, 2]
        levels.append(np.asarray(red | green << 8 | blue << 16, dtype=np.uint32))
    return levels, log2_side


def pack(images: list[Pixels]) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Concatenate all pyramids; also returns (textures, MIP_LEVELS + 1) level starts, then log2."""
    texels: list[NDArray[np.uint32]] = [np.zeros(2, dtype=np.uint32)]
    table = np.zeros((max(1, len(images)), MIP_LEVELS + 1), dtype=np.int64)
    start = 2
    for row, image in enumerate(images):
        levels, log2_side = pyramid(image.shape, image.tobytes())
        for level, data in enumerate(levels):
            table[row, level] = start
            texels.append(data)
            start += len(data)
        table[row, MIP_LEVELS] = log2_side
    return np.concatenate(texels), table


PALETTE_ERROR = 4.0
"""Maximum mean difference (of 255) within the faces of a palette texture."""
PALETTE_COLORS = 24
"""Maximum number of colours of a palette, which cover nearly all of the surface."""


def face_texels(uv: Floats, image: Pixels) -> Floats:
    """Look up (f, 4, 3) texels, 0..255, at the corners (f, 3, 2) and at the middle of each face."""
    height, width = image.shape[:2]
    spots = np.concatenate([uv, uv.mean(1, keepdims=True)], 1)
    x = np.floor(spots[..., 0] % 1.0 * width).astype(np.int64) % width
    y = np.floor((1.0 - spots[..., 1]) % 1.0 * height).astype(np.int64) % height
    return np.asarray(image[y, x].astype(np.float64))


def palette_colors(mesh: RasterMesh, image: Pixels) -> Floats | None:
    """Compute (f, 3) face colours 0..1 if each face is on one colour of the texture; else None.

    Such a texture is a palette: colours by face are faster, do not bleed into each other in small images, and
    survive decimation.
    """
    if mesh.uv is None or mesh.num_faces == 0:
        return None
    found = face_texels(mesh.uv, image)
    difference = np.abs(found - found[:, 3:]).max((1, 2))
    area = np.sqrt((face_normals(mesh.points, mesh.faces) ** 2).sum(1))
    if float((area * difference).sum() / area.sum()) > PALETTE_ERROR:
        return None
    color = np.median(found, axis=1)
    _, kind = np.unique(np.round(color / 8), axis=0, return_inverse=True)
    share = np.sort(np.bincount(kind.reshape(-1), weights=area))[::-1]
    if share[:PALETTE_COLORS].sum() < 0.95 * area.sum():
        return None
    return np.asarray(color / 255.0)
