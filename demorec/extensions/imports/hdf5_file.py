"""HDF5 files of unknown origin, read in pieces.

A link can lead into any other file of the machine, and a dataset can have its numbers elsewhere or rows that nobody
wrote: all of these are refused. Only numbers and texts are made of the content.
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
_MAX_DEPTH = 6
"""Levels of groups that are searched for datasets."""
_BLOCK_BYTES = 8 << 20
"""Of rows that are read at once; whole chunks of the file, unless these are larger than `_MAX_BLOCK_BYTES`."""
_MAX_BLOCK_BYTES = 64 << 20
_KINDS: dict[int, Kind] = {h5py.h5o.TYPE_GROUP: "group", h5py.h5o.TYPE_DATASET: "dataset"}
_REASONS = (
    ("truncated file", "it is cut off"),
    ("required filter", "it is compressed in a way that is not installed here"),
    ("can't open directory", "it is compressed in a way that is not installed here"),  # that of filters
    ("No NumPy equivalent", "it is of a kind that is no plain number"),
)
"""What the HDF5 library says, and what it means; all else means that the file is damaged."""


class Hdf5Error(DemorecError):
    """An HDF5 file cannot be read, or does not hold what it should."""


class StoredArray:
    """A dataset whose numbers are all in the file.

    Attributes:
        place: Its name in the file.
        shape: Of all rows.
        dtype: Of a number: integer, float or bool.
        is_ragged: Whether each row is as long as it likes: files in a dataset of variable length.
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
        """Rows from `begin` to before `end`; Hdf5Error when they cannot be read."""
        with _errors_reported(f"{self.place} cannot be read", self._file):
            rows: NDArray[np.generic] = self._dataset[begin:end]
        return rows

    def rows(self) -> Iterator[NDArray[np.generic]]:
        """One row after the other, some of them in memory at a time."""
        step = self._rows_at_once()
        for begin in range(0, len(self), step):
            yield from self.read(begin, min(begin + step, len(self)))

    def attribute(self, name: str) -> Scalar | None:
        """An attribute of the dataset, as of `ForeignFile.attribute`."""
        return _attribute(self._dataset, name, self.place, self._file)

    def _rows_at_once(self) -> int:
        if self.is_ragged:  # how long a row is, only reading it says
            return 1
        row = max(1, math.prod(self.shape[1:]) * self.dtype.itemsize)
        chunk = self._dataset.chunks[0] if self._dataset.chunks else 1
        step = chunk * max(1, _BLOCK_BYTES // (chunk * row))
        return step if step * row <= _MAX_BLOCK_BYTES else max(1, _MAX_BLOCK_BYTES // row)


class ForeignFile(Closing):
    """An HDF5 file that anyone may have written; a context manager.

    Attributes:
        path: Of it.

    Raises:
        Hdf5Error: It is none, cut off or damaged; so do all methods.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _errors_reported("The HDF5 file cannot be read", path):
            with open_regular(path) as file:
                if file.read(len(HDF5_MAGIC)) != HDF5_MAGIC:
                    raise Hdf5Error(f"This is no HDF5 file: {path}")
            self._root = h5py.File(path, "r", locking=False)

    def close(self) -> None:
        """Close the file; harmless when called twice."""
        self._root.close()

    def children(self, place: str) -> dict[str, Kind]:
        """What a group holds: name -> what it is; links are "other"."""
        group = self._find(place)
        if not isinstance(group, h5py.Group):
            raise Hdf5Error(f"{_shown(place)} is no group: {self.path}")
        with _errors_reported(f"{_shown(place)} cannot be read", self.path):
            return {str(name): self._kind(group, str(name)) for name in group}

    def datasets(self, place: str) -> Iterator[str]:
        """The places of all datasets below a group, some levels deep; each group once, which may be in itself."""
        waiting, seen = [(place, 0)], {self.address(place)}
        while waiting:
            group, depth = waiting.pop()
            below = [(f"{group}/{name}".lstrip("/"), kind) for name, kind in self.children(group).items()]
            yield from (name for name, kind in below if kind == "dataset")
            for name, kind in reversed(below):
                if kind == "group" and depth < _MAX_DEPTH and (address := self.address(name)) not in seen:
                    seen.add(address)
                    waiting.append((name, depth + 1))

    def has(self, place: str) -> bool:
        """Whether there is a group or dataset of that name; what a link leads to is not there."""
        try:
            self._find(place)
        except Hdf5Error:
            return False
        return True

    def is_group(self, place: str) -> bool:
        """Whether there is a group of that name."""
        try:
            return isinstance(self._find(place), h5py.Group)
        except Hdf5Error:
            return False

    def attribute(self, place: str, name: str) -> Scalar | None:
        """A text, number or boolean that is an attribute of a group or dataset; None when it has none of that name."""
        return _attribute(self._find(place), name, _shown(place), self.path)

    def array(self, place: str, *, may_be_ragged: bool = False) -> StoredArray:
        """A dataset of rows, with `may_be_ragged` also one of bytes of variable length.

        Raises:
            Hdf5Error: There is none, it holds no plain numbers, has no rows, was never written, or leads out of the
                file.
        """
        found = self._find(place)
        with _errors_reported(f"{place} cannot be read", self.path):
            reason = _why_unusable(found, may_be_ragged)
        if reason:
            raise Hdf5Error(f"{place} cannot be used, since {reason}: {self.path}")
        return StoredArray(self.path, place, found)

    def names(self, place: str) -> list[str]:
        """A dataset of texts, as robomimic's masks are.

        Raises:
            Hdf5Error: There is none, or it is no list of texts.
        """
        found = self._find(place)
        with _errors_reported(f"{place} cannot be read", self.path):
            is_list = isinstance(found, h5py.Dataset) and len(found.shape or ()) == 1 and not found.is_virtual
            kind = h5py.check_string_dtype(found.dtype) if is_list else None
            if kind is None or found.external:
                raise Hdf5Error(f"{place} is no list of texts: {self.path}")
            return [str(text) for text in found.asstr(errors="replace")[:]]

    def address(self, place: str) -> int:
        """By which a group or dataset is known, whatever it is called: it may have several names."""
        found = self._find(place)
        with _errors_reported(f"{_shown(place)} cannot be read", self.path):
            return int(h5py.h5o.get_info(found.id).addr)

    def _find(self, place: str) -> h5py.Group | h5py.Dataset:
        """What has a name, by hard links alone: others can lead out of the file, or in circles."""
        found: h5py.Group | h5py.Dataset = self._root
        walked = ""
        for part in filter(None, place.split("/")):
            with _errors_reported(f"{walked}{part} cannot be read", self.path):
                names = found if isinstance(found, h5py.Group) else ()
                if part not in names:
                    near = nearest_match(part, list(names)).rstrip("?")
                    raise Hdf5Error(f"There is no {walked}{part}.{near and f'{near}?'}".rstrip(".") + f": {self.path}")
                if self._kind(found, part) == "other":
                    raise Hdf5Error(
                        f"{walked}{part} is a link or a type, only groups and datasets within the file are read: "
                        f"{self.path}"
                    )
                found, walked = found[part], f"{walked}{part}/"
        return found

    @staticmethod
    def _kind(group: h5py.Group, name: str) -> Kind:
        key = name.encode(errors="surrogateescape")  # h5py's lower level takes a fraction of the other's time
        if group.id.links.get_info(key).type != h5py.h5l.TYPE_HARD:
            return "other"
        return _KINDS.get(h5py.h5o.get_info(group.id, key).type, "other")


def _why_unusable(found: h5py.Group | h5py.Dataset, may_be_ragged: bool) -> str:
    """Why the numbers of a dataset are not read, in words; "" when they are."""
    if not isinstance(found, h5py.Dataset):
        return "it is a group"
    is_ragged = may_be_ragged and found.ndim == 1 and h5py.check_vlen_dtype(found.dtype) == np.uint8
    if not is_ragged and (found.dtype.kind not in "fiub" or found.dtype.itemsize > 8):
        return f"it holds {found.dtype.name if found.dtype.kind != 'O' else 'objects'}, no plain numbers"
    if not found.shape:
        return "it has no rows"
    if found.is_virtual or found.external:
        return "its numbers are in other files"
    return "" if found.size == 0 or _is_written(found) else "not all of its rows were written"


def _is_written(dataset: h5py.Dataset) -> bool:
    """Whether all rows are in the file; HDF5 invents zeros for those that are not."""
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
        return _scalar(value.item() if isinstance(value, np.ndarray) else value)


def _scalar(value: object) -> Scalar | None:
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    if isinstance(value, np.generic):
        value = value.item()
    return value if isinstance(value, str | bool | int | float) else None


def _shown(place: str) -> str:
    return place or "The file's root"


@contextmanager
def _errors_reported(what: str, path: Path) -> Iterator[None]:
    """Turn what the HDF5 library raises into an error that begins with what it was."""
    try:
        yield
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError) as error:
        reason = error.strerror if isinstance(error, OSError) else ""
        reason = reason or next((words for said, words in _REASONS if said in str(error)), "it is damaged")
        raise resource_error(error, path) or Hdf5Error(f"{what} ({reason}): {path}") from error
