"""Streams of an episode in an HDF5 file: vectors with the names of their elements, and pictures."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence

import h5py
import numpy as np
from numpy.typing import NDArray

GYM = 2
"""`EnvType.GYM_TYPE` of robomimic."""


def add_vectors(group: h5py.Group, name: str, values: NDArray[np.generic], components: Sequence[str]) -> None:
    """(T, D) numbers as a dataset whose attribute `names` has those of the D components."""
    stored = group.create_dataset(name, data=values)
    stored.attrs["names"] = json.dumps(components)


def add_pictures(
    group: h5py.Group, name: str, shape: tuple[int, ...], pictures: Iterable[NDArray[np.generic]], compression: int
) -> None:
    """A stream of pictures, each a compressed chunk of its own, so that one is read by itself.

    Args:
        group: Where it goes.
        name: Of the dataset.
        shape: Of all pictures: (T, H, W, 3) of colours, uint8; (T, H, W, 1) of distances, float32.
        pictures: One after the other.
        compression: Level of gzip, 0 for none.
    """
    stored = group.create_dataset(
        name,
        shape,
        np.uint8 if shape[-1] == 3 else np.float32,
        chunks=(1, *shape[1:]),
        compression="gzip" if compression else None,
        compression_opts=compression or None,
    )
    for index, picture in enumerate(pictures):
        stored[index] = picture.reshape(shape[1:])
