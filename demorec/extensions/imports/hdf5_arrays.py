"""Content of an HDF5 file's datasets: bit-exact vectors, and images as pixels, JPEG or depth."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from demorec.core.config import MAX_PIXELS
from demorec.episode.info import Camera, Feature, Kept
from demorec.extensions.imports.description import imported_feature
from demorec.extensions.imports.episode_writer import Image
from demorec.extensions.imports.fields import FieldError, names_of, picked
from demorec.extensions.imports.hdf5_file import Hdf5Error, StoredArray
from demorec.extensions.imports.image_messages import decode_image, image_head
from demorec.extensions.imports.mapping import MAX_ELEMENTS, CameraSource, Source
from demorec.mcap.cdr import Values

_EXACT = 2**53
"""Maximum integer up to which float64 is exact."""


class StoredFeature:
    """A feature of an episode; FieldError if its datasets are not vectors.

    Args:
        shift: Number of rows by which frames precede the datasets' rows: 1 for the next row of a feature.
    """

    def __init__(self, name: str, parts: Sequence[Source], arrays: Sequence[StoredArray], *, shift: int) -> None:
        self.name, self.shift, self.arrays = name, shift, arrays
        self._parts = parts
        self._names = [_names(part, array) for part, array in zip(parts, arrays, strict=True)]

    def described(self, dtype: DTypeLike) -> Feature:
        """Describe it in recordings' form, with vectors of this type."""
        names = tuple(name for part_names in self._names for name in part_names)
        units = [part.unit for part, own in zip(self._parts, self._names, strict=True) for _ in own]
        called = (name.removesuffix(".pos") for name in names)  # LeRobot's suffix for the position of a joint
        source = "; ".join(part.dataset for part in self._parts) + (" of the next row" if self.shift else "")
        return imported_feature(self.name, dtype, names, units, called=called, source=source)

    def vectors(self, count: int) -> NDArray[np.floating[Any]]:
        """Read (T, D) of the first `count` frames: float32 if it holds all numbers, otherwise float64.

        Raises:
            FieldError: A number is not finite, or float64 cannot hold it.
            Hdf5Error: They cannot be read.
        """
        parts = zip(self._parts, self.arrays, self._names, strict=True)
        begin, end = self.shift, self.shift + count
        return np.concatenate([_rows(part, array, names, begin, end) for part, array, names in parts], axis=1)


def _rows(part: Source, array: StoredArray, names: Sequence[str], begin: int, end: int) -> NDArray[np.floating[Any]]:
    """Read (end - begin, D) of one part; errors as in `StoredFeature.vectors`."""
    rows: NDArray[Any] = array.read(begin, end).reshape(end - begin, -1)
    rows = rows[:, list(part.elements)] if part.elements else rows
    if rows.dtype.kind in "iu" and ((rows > _EXACT) | (rows < -_EXACT)).any():
        raise FieldError(f"{array.place} has whole numbers that float64 cannot hold")
    is_small = rows.dtype.kind == "f" and rows.dtype.itemsize <= 4
    values: NDArray[np.floating[Any]] = rows.astype(np.float32 if is_small else np.float64)
    if len(wrong := np.argwhere(~np.isfinite(values))):
        row, element = wrong[0].tolist()
        number, place = values[row, element], f"row {begin + row} ({names[element]})"
        raise FieldError(f"{array.place} is {number} in {place}, numbers must be finite")
    return values


def _names(part: Source, array: StoredArray) -> tuple[str, ...]:
    """Return the names of the selected elements."""
    if len(array.shape) > 2:
        shape = "x".join(map(str, array.shape))
        raise FieldError(f"{array.place} is an array of {shape}, a feature takes rows of numbers")
    count = array.shape[1] if len(array.shape) == 2 else 1
    if not 1 <= count <= MAX_ELEMENTS:
        raise FieldError(f"{array.place} has {count:,} numbers a row, allowed are 1 to {MAX_ELEMENTS:,}")
    return names_of(part, picked(part, _labels(array, count), array.place), array.place)


def _labels(array: StoredArray, count: int) -> list[str]:
    """Names of the dataset's elements in its attribute `names`, or else its own name and a number."""
    try:
        named = json.loads(str(array.attribute("names") or ""))
    except (ValueError, RecursionError, Hdf5Error):
        named = None
    is_list = isinstance(named, list) and len(named) == count and all(isinstance(name, str) for name in named)
    if is_list and all(name and name.isprintable() and "," not in name for name in named):
        return list(named)
    base = array.place.rpartition("/")[2].replace(",", " ")
    return [base] if len(array.shape) == 1 else [f"{base}_{number}" for number in range(count)]


_LEAST_SIDE = 16
"""Minimum side in pixels: smaller arrays of floats are not depth unless the mapping names them as such."""
_JPEG, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"


class StoredCamera:
    """A camera of an episode.

    Attributes:
        width, height: Pixels.
        kept: "jpeg" for passthrough JPEG files, "16UC1" or "32FC1" for depth; "" for pixels, which are encoded once.
        description: Treatment of the images, in words.

    Raises:
        FieldError: They are not images.
        Hdf5Error: They cannot be read.
    """

    def __init__(self, name: str, camera: CameraSource, array: StoredArray) -> None:
        self.name = name
        self._camera, self._array, self._form = camera, array, image_form(array)
        self.kept: Kept = ""
        if self._form == "jpeg":
            _, self.width, self.height = self._file(array.read(0, 1)[0], 0)
            self.kept = "jpeg" if camera.colors == "rgb" else ""
            self.description = "jpeg passed through as it is" if self.kept else "jpeg"
        elif self._form == "depth":
            self.height, self.width = array.shape[1:3]
            self.kept = "16UC1" if array.dtype.itemsize == 2 else "32FC1"
            self.description = f"distances ({self.kept}) passed through as they are"
        elif self._form == "pixels":
            self.height, self.width = array.shape[1:3] if array.shape[3] == 3 else array.shape[2:]
            self.description = "pixels"
        else:
            raise FieldError(
                f"{array.place} is {array.dtype.name} of {'x'.join(map(str, array.shape))}, images are uint8 of rows, "
                "height, width and 3 colours, or of rows, 3 colours, height and width, or rows of JPEG, distances "
                "uint16 or float32 of rows, height, width"
            )
        if not self.kept:
            self.description += f"{'' if camera.colors == 'rgb' else ' with red and blue exchanged'}, encoded once"
        if not 1 <= self.width * self.height <= MAX_PIXELS:
            raise FieldError(f"{array.place} has {self.width}x{self.height} pixels, allowed are 1 to {MAX_PIXELS}")

    def described(self) -> Camera:
        """The camera in recordings' form."""
        place = self._camera.dataset
        return Camera(name=self.name, width=self.width, height=self.height, kept=self.kept, source=place)

    def images(self) -> Iterator[Image]:
        """Yield one image per row; FieldError if a JPEG file is truncated, or has another size."""
        for number, row in enumerate(self._array.rows()):
            if self._form == "depth":
                yield row.reshape(self.height, self.width).astype(row.dtype.newbyteorder("="), copy=False)
                continue
            image: Image = row
            if self._form == "pixels" and row.shape[2] != 3:
                image = np.ascontiguousarray(row.transpose(1, 2, 0))
            if self._form == "jpeg":
                image, width, height = self._file(row, number)
                if (width, height) != (self.width, self.height):
                    raise FieldError(f"{self._array.place} changes its size to {width}x{height} in row {number}")
                image = image if self.kept else self._used(decode_image, image, number)
            if not isinstance(image, bytes) and self._camera.colors == "bgr":
                image = np.ascontiguousarray(image[:, :, ::-1])
            yield image

    def _file(self, row: NDArray[np.generic], number: int) -> tuple[bytes, int, int]:
        """JPEG file of a row without padding (it ends with its end marker, never with a zero), and its size."""
        data = row.tobytes().rstrip(b"\0")
        if not data.endswith(_JPEG_END):
            raise FieldError(f"{self._array.place} holds no whole JPEG file in row {number}")
        head = self._used(image_head, data, number)
        if head.format != "jpeg":
            raise FieldError(f"{self._array.place} holds {head.format} in row {number}, not a JPEG file")
        return data, head.width, head.height

    def _used[T](self, read: Callable[[Values], T], data: bytes, number: int) -> T:
        """Apply `read` to the JPEG file in a row."""
        try:
            return read({"format": "jpeg", "data": data})
        except FieldError as error:
            raise FieldError(f"{self._array.place} cannot be used in row {number}, since {error}") from error


def is_camera(array: StoredArray) -> bool:
    """Whether a dataset holds images, JPEG files or, by its name or last axis, depth."""
    form, place = image_form(array), array.place.rpartition("/")[2]
    if form == "jpeg":
        return len(array) > 0 and array.read(0, 1)[0].tobytes().startswith(_JPEG)
    is_image = len(array.shape) == 4 and min(array.shape[1:3]) >= _LEAST_SIDE  # form of depth in demorec's own exports
    return form == "pixels" or (form == "depth" and (is_image or "depth" in place))


def image_form(array: StoredArray) -> Literal["pixels", "jpeg", "depth"] | None:
    """Image format that the rows of a dataset may have; None for numbers that are not images."""
    shape, kind = array.shape, array.dtype
    if array.is_ragged or (kind == np.uint8 and len(shape) == 2):
        return "jpeg"
    if len(shape) == 4 and kind == np.uint8 and 3 in (shape[1], shape[3]):
        return "pixels"
    is_flat = len(shape) == 3 or (len(shape) == 4 and shape[3] == 1)
    return "depth" if is_flat and (kind.kind, kind.itemsize) in (("u", 2), ("f", 4)) else None
