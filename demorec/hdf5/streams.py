"""Streams of an episode in an HDF5 file: vectors with the names of their elements, and pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence

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
    group: h5py.Group, name: str, shape: tuple[int, ...], kind: type[np.generic], compression: int
) -> h5py.Dataset:
    """An empty stream of pictures, each a compressed chunk of its own, so that one is read by itself.

    Args:
        group: Where it goes.
        name: Of the dataset.
        shape: Of all pictures: (T, H, W, C).
        kind: Of a number.
        compression: Level of gzip, 0 for none.
    """
    return group.create_dataset(
        name,
        shape,
        kind,
        chunks=(1, *shape[1:]),
        compression="gzip" if compression else None,
        compression_opts=compression or None,
    )
