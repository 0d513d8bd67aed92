"""The numbers of an episode in an HDF5 file: features of one dataset or several, read in pieces, every bit as it is."""

from __future__ import annotations

import json
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.datasets.hdf5.foreign import Hdf5Error, StoredArray
from demorec.episode.external import Feature, Vector
from demorec.sources.fields import converted
from demorec.sources.hdf5_mapping import DatasetPart
from demorec.sources.mapping_file import MAX_ELEMENTS, STATE, conversion_factor, recorded_unit

_BLOCK_ROWS = 1024
_EXACT = 2**53
"""Up to which float64 holds every whole number."""


class Hdf5FitError(ValueError):
    """A dataset is not what the mapping takes it for; `str` says why, for the inside of a sentence."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Column:
    """One part of a feature, and where its numbers are."""

    part: DatasetPart
    array: StoredArray
    names: tuple[str, ...]

    @property
    def is_single(self) -> bool:
        """Whether float32 holds all its numbers."""
        kind = self.array.dtype
        return kind.kind == "f" and kind.itemsize <= 4 and conversion_factor(self.part.unit, self.part.to) is None

    def block(self, begin: int, end: int) -> NDArray[np.floating[Any]]:
        rows: NDArray[Any] = self.array.read(begin, end).reshape(end - begin, -1)
        if self.part.elements:
            rows = rows[:, list(self.part.elements)]
        if rows.dtype.kind in "iu" and ((rows > _EXACT) | (rows < -_EXACT)).any():
            raise Hdf5FitError(f"{self.array.place} has whole numbers that float64 cannot hold")
        is_small = rows.dtype.kind == "f" and rows.dtype.itemsize <= 4
        return converted(self.part, rows.astype(np.float32 if is_small else np.float64))


class StoredFeature:
    """A feature of an episode.

    Attributes:
        columns: Of each part the dataset.

    Args:
        name: Of it.
        parts, arrays: What it is made of, and where each is.
        shift: By how many rows the frames are behind the datasets' rows: 1 for what another feature is next.

    Raises:
        Hdf5FitError: They are no vectors.
    """

    def __init__(self, name: str, parts: Sequence[DatasetPart], arrays: Sequence[StoredArray], *, shift: int) -> None:
        self.name, self.shift = name, shift
        pairs = zip(parts, arrays, strict=True)
        self.columns = tuple(_Column(part=part, array=array, names=_names(part, array)) for part, array in pairs)

    @property
    def dtype(self) -> type[np.float32] | type[np.float64]:
        """float32 where that holds all numbers as they are."""
        return np.float32 if all(column.is_single for column in self.columns) else np.float64

    def described(self, joints: Container[str]) -> Feature:
        """The feature as recordings know it, given the joints of the robot's model."""
        names = tuple(name for column in self.columns for name in column.names)
        units = tuple(
            recorded_unit(column.part.to or column.part.unit) for column in self.columns for _ in column.names
        )
        called = (name.removesuffix(".pos") for name in names)  # as LeRobot calls the position of a joint
        moves = tuple(name if name in joints and self.name == STATE else "" for name in called)
        source = "; ".join(column.part.dataset for column in self.columns)
        return Feature(
            name=self.name,
            dtype="float32" if self.dtype is np.float32 else "float64",
            names=names,
            units=units if any(units) else (),
            joints=moves if any(moves) else (),
            source=f"{source} of the next row" if self.shift else source,
        )

    def vectors(self, count: int) -> Iterator[Vector]:
        """(D,) of each of the first `count` frames.

        Raises:
            Hdf5FitError: A number is not finite, or not to be held.
            Hdf5Error: They cannot be read.
        """
        for begin in range(0, count, _BLOCK_ROWS):
            first, last = begin + self.shift, min(begin + _BLOCK_ROWS, count) + self.shift
            parts = [column.block(first, last) for column in self.columns]
            for column, part in zip(self.columns, parts, strict=True):
                if len(wrong := np.argwhere(~np.isfinite(part))):
                    row, element = wrong[0].tolist()
                    raise Hdf5FitError(
                        f"{column.array.place} is {part[row, element]} in row {first + row} ({column.names[element]}), "
                        "numbers must be finite"
                    )
            yield from np.concatenate(parts, axis=1).astype(self.dtype)


def _names(part: DatasetPart, array: StoredArray) -> tuple[str, ...]:
    """Of the elements that are taken."""
    if len(array.shape) > 2:
        shape = "x".join(map(str, array.shape))
        raise Hdf5FitError(f"{array.place} is an array of {shape}, a feature takes rows of numbers")
    count = array.shape[1] if len(array.shape) == 2 else 1
    if not 1 <= count <= MAX_ELEMENTS:
        raise Hdf5FitError(f"{array.place} has {count:,} numbers a row, allowed are 1 to {MAX_ELEMENTS:,}")
    if outside := [element for element in part.elements if element >= count]:
        raise Hdf5FitError(f"there is no element {outside[0]} among the {count} of {array.place}")
    labels = _labels(array, count)
    labels = [labels[element] for element in part.elements] if part.elements else labels
    for what, given in (("names", part.names), ("limits", part.limits)):
        if given and len(given) != len(labels):
            raise Hdf5FitError(f"{what} has {len(given)} entries for the {len(labels)} elements of {array.place}")
    return tuple(part.prefix + name for name in part.names or labels)


def _labels(array: StoredArray, count: int) -> list[str]:
    """What the dataset's attribute `names` calls its elements, where it has one, or else its own name and a number."""
    try:
        named = json.loads(str(array.attribute("names") or ""))
    except (ValueError, RecursionError, Hdf5Error):
        named = None
    is_list = isinstance(named, list) and len(named) == count and all(isinstance(name, str) for name in named)
    if is_list and all(name and name.isprintable() and "," not in name for name in named):
        return list(named)
    base = array.place.rpartition("/")[2].replace(",", " ")
    return [base] if len(array.shape) == 1 else [f"{base}_{number}" for number in range(count)]
