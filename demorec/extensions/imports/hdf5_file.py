"""HDF5 files of unknown origin, read in parts.

A link can refer to any other file of the machine, and a dataset can store its numbers elsewhere or have rows that were
never written: all of these are refused. Only numbers and texts are read from the content.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import DemorecError, resource_error
from demorec.core.files import HDF5_MAGIC, Closing, open_regular
from demorec.core.registry import nearest_match

Kind = Literal["group", "dataset", "other"]
Scalar = str | bool | int | float
_BLOCK_BYTES = 8 << 20
"""Size of the rows read at once from a dataset without chunks."""
_MAX_BLOCK_BYTES = 64 << 20
_KINDS: dict[type | None, Kind] = {h5py.Group: "group", h5py.Dataset: "dataset"}
_REASONS = (
    ("truncated file", "it is cut off"),
    ("required filter", "it is compressed in a way that is not installed here"),
    ("No NumPy equivalent", "its type is not a plain number"),
)
"""Messages of the HDF5 library and their meaning; all others mean that the file is damaged."""


class Hdf5Error(DemorecError):
    """An HDF5 file cannot be read, or lacks expected content."""


class StoredArray:
    """A dataset with all its numbers in the file.

    Attributes:
        place: Its name in the file.
        shape: Shape of all rows.
        dtype: Type of a number: integer, float or bool.
        is_ragged: Whether rows differ in length: files in a dataset of variable length.
    """

    def __init__(self, file: Path, place: str, dataset: h5py.Dataset) -> None:
        self.place = place
        self.shape: tuple[int, ...] = dataset.shape
        self.is_ragged = dataset.dtype.kind == "O"
        self.dtype: np.dtype[np.generic] = np.dtype(np.uint8) if self.is_ragged else dataset.dtype
        self._file, self._dataset = file, dataset

    def __len__(self) -> int:
        return self.shape[0]

    def read(self, begin: int, end: int) -> NDArray[np.generic]:
        """Read rows `begin` to `end` - 1; Hdf5Error if they cannot be read."""
        with _errors_reported(f"{self.place} cannot be read", self._file):
            rows: NDArray[np.generic] = self._dataset[begin:end]
        return rows

    def rows(self) -> Iterator[NDArray[np.generic]]:
        """Yield row after row, with some of them in memory at a time: whole chunks of the file, unless these are
        large.
        """
        row_bytes = max(1, math.prod(self.shape[1:]) * self.dtype.itemsize)
        step = self._dataset.chunks[0] if self._dataset.chunks else _BLOCK_BYTES // row_bytes
        step = 1 if self.is_ragged else max(1, min(step, _MAX_BLOCK_BYTES // row_bytes))
        for begin in range(0, len(self), step):
            yield from self.read(begin, min(begin + step, len(self)))

    def attribute(self, name: str) -> Scalar | None:
        """An attribute of the dataset, as in `ForeignFile.attribute`."""
        return _attribute(self._dataset, name, self.place, self._file)


class ForeignFile(Closing):
    """An HDF5 file from any writer; a context manager.

    Its groups and datasets are those with a hard link, each under one name: other links can lead out of the file, or
    in circles.

    Raises:
        Hdf5Error: It is not HDF5, truncated or damaged; raised by all methods.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._items: dict[str, h5py.Group | h5py.Dataset] = {}
        with _errors_reported("The HDF5 file cannot be read", path):
            with open_regular(path) as file:
                if file.read(len(HDF5_MAGIC)) != HDF5_MAGIC:
                    raise Hdf5Error(f"This is not an HDF5 file: {path}")
            self._root = h5py.File(path, "r", locking=False)
            self._root.visititems(self._items.__setitem__)

    def close(self) -> None:
        """Close the file; idempotent."""
        self._items.clear()
        self._root.close()

    def children(self, place: str) -> dict[str, Kind]:
        """Entries of a group: name -> kind; links are "other"."""
        group = self._find(place)
        if not isinstance(group, h5py.Group):
            raise Hdf5Error(f"{_shown(place)} is not a group: {self.path}")
        with _errors_reported(f"{_shown(place)} cannot be read", self.path):
            items = {str(name): self._items.get(f"{place}/{name}".lstrip("/")) for name in group}
        return {name: _KINDS.get(type(item), "other") for name, item in items.items()}

    def datasets(self, place: str) -> list[str]:
        """Paths of all datasets below a group."""
        inside = f"{place}/" if place else ""
        items = self._items.items()
        return [name for name, item in items if isinstance(item, h5py.Dataset) and name.startswith(inside)]

    def has(self, place: str) -> bool:
        """Whether a group or dataset with that name exists; targets of links do not count."""
        return place.strip("/") in self._items

    def is_group(self, place: str) -> bool:
        """Whether a group with that name exists."""
        return isinstance(self._items.get(place), h5py.Group)

    def attribute(self, place: str, name: str) -> Scalar | None:
        """A text, number or boolean attribute of a group or dataset; None if it is missing."""
        return _attribute(self._find(place), name, _shown(place), self.path)

    def array(self, place: str, *, may_be_ragged: bool = False) -> StoredArray:
        """Open a dataset of rows, with `may_be_ragged` also one of variable-length bytes.

        Raises:
            Hdf5Error: It is missing, has no plain numbers or no rows, was never written, or refers to another file.
        """
        found = self._find(place)
        with _errors_reported(f"{place} cannot be read", self.path):
            reason = _why_unusable(found, may_be_ragged)
        if reason:
            raise Hdf5Error(f"{place} cannot be used, since {reason}: {self.path}")
        return StoredArray(self.path, place, found)

    def _find(self, place: str) -> h5py.Group | h5py.Dataset:
        if not place or place in self._items:
            return self._items.get(place, self._root)
        parent, _, name = place.rpartition("/")
        names = self.children(parent)
        if name in names:
            raise Hdf5Error(
                f"{place} is a link, a type or a second name, only groups and datasets within the file are read, each "
                f"under one name: {self.path}"
            )
        near = nearest_match(name, names).rstrip("?")
        raise Hdf5Error(f"Missing {place}.{near and f'{near}?'}".rstrip(".") + f": {self.path}")


def _why_unusable(found: h5py.Group | h5py.Dataset, may_be_ragged: bool) -> str:
    """Reason why the numbers of a dataset cannot be used, in words; "" if they can."""
    if not isinstance(found, h5py.Dataset):
        return "it is a group"
    is_ragged = may_be_ragged and found.ndim == 1 and h5py.check_vlen_dtype(found.dtype) == np.uint8
    if not is_ragged and (found.dtype.kind not in "fiub" or found.dtype.itemsize > 8):
        return f"it holds {found.dtype.name if found.dtype.kind != 'O' else 'objects'}, not plain numbers"
    if not found.shape:
        return "it has no rows"
    if found.is_virtual or found.external:
        return "its numbers are in other files"
    return "" if found.size == 0 or _is_written(found) else "not all of its rows were written"


def _is_written(dataset: h5py.Dataset) -> bool:
    """Whether all rows are in the file; HDF5 fills in zeros for missing ones."""
    if dataset.chunks:
        counts = [-(-size // chunk) for size, chunk in zip(dataset.shape, dataset.chunks, strict=True)]
        return bool(dataset.id.get_num_chunks() == math.prod(counts))
    return bool(dataset.id.get_storage_size() >= dataset.nbytes)


def _attribute(found: h5py.Group | h5py.Dataset, name: str, place: str, path: Path) -> Scalar | None:
    with _errors_reported(f"The attribute {name} of {place} cannot be read", path):
        if name not in found.attrs:
            return None
        attribute = found.attrs.get_id(name)
        if attribute.get_space().get_simple_extent_type() == h5py.h5s.NULL or attribute.shape not in ((), (1,)):
            return None
        value = found.attrs[name]
        value = value.item() if isinstance(value, np.ndarray | np.generic) else value
        value = value.decode(errors="replace") if isinstance(value, bytes) else value
        return value if isinstance(value, str | bool | int | float) else None


def _shown(place: str) -> str:
    return place or "The file's root"


@contextmanager
def _errors_reported(what: str, path: Path) -> Iterator[None]:
    """Turn the HDF5 library's errors into an Hdf5Error that begins with `what`."""
    try:
        yield
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError) as error:
        reason = error.strerror if isinstance(error, OSError) else ""
        reason = reason or next((words for said, words in _REASONS if said in str(error)), "it is damaged")
        raise resource_error(error, path) or Hdf5Error(f"{what} ({reason}): {path}") from error
