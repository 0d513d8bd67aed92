"""Columns of a table as arrays, from which the rows of a whole batch are taken at once.

A table of LeRobot is a memory-mapped Arrow file in chunks. Long columns stay where they are, and several processes
share them; short ones are joined, so that one index is enough to take rows from them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray

_JOINED_BYTES = 64 << 20
"""Columns of up to so many bytes are joined."""


class Column:
    """Numbers of one feature, a row for each frame.

    Args:
        chunks: Arrays of (n, ...) one after the other; (0, ...) at least.
    """

    def __init__(self, chunks: Sequence[NDArray[Any]]) -> None:
        joined = len(chunks) == 1 or sum(chunk.nbytes for chunk in chunks) <= _JOINED_BYTES
        self._chunks = [np.concatenate(chunks)] if joined and len(chunks) > 1 else list(chunks)
        self._starts = np.cumsum([0, *(len(chunk) for chunk in self._chunks)])

    def __len__(self) -> int:
        return int(self._starts[-1])

    def take(self, rows: NDArray[np.int64]) -> NDArray[Any]:
        """The given rows, an array of `rows.shape` and the shape of a value, in memory of its own."""
        if len(self._chunks) == 1:
            return self._chunks[0][rows]
        flat = rows.reshape(-1)
        order = np.argsort(flat, kind="stable")
        in_order = flat[order]
        bounds = np.searchsorted(in_order, self._starts)
        taken = np.empty((len(flat), *self._chunks[0].shape[1:]), self._chunks[0].dtype)
        for number in np.flatnonzero(np.diff(bounds)):
            part = slice(bounds[number], bounds[number + 1])
            taken[order[part]] = self._chunks[number][in_order[part] - self._starts[number]]
        return taken.reshape(*rows.shape, *taken.shape[1:])

    def tensor(self, rows: NDArray[np.int64]) -> torch.Tensor:
        """The given rows with the type that `torch.tensor` gives to numbers of Python."""
        values = torch.from_numpy(self.take(rows))
        if values.dtype.is_floating_point:
            return values.to(torch.get_default_dtype())
        return values if values.dtype == torch.bool else values.to(torch.int64)


def numbers(column: pa.ChunkedArray) -> Column | None:
    """The column as arrays; None when it holds anything but numbers of one shape without gaps."""
    chunks = [_array(chunk) for chunk in column.chunks if len(chunk)]
    known = [chunk for chunk in chunks if chunk is not None]
    if not known or len(known) < len(chunks) or len({chunk.shape[1:] for chunk in known}) > 1:
        return None
    return Column(known)


def _array(chunk: pa.Array) -> NDArray[Any] | None:
    """(n, ...) of a chunk, a view of its memory unless it holds bits (bool); None as of `numbers`."""
    shape = [len(chunk)]
    while True:
        if chunk.null_count:
            return None
        if isinstance(chunk, pa.ExtensionArray):
            chunk = chunk.storage
        elif pa.types.is_fixed_size_list(chunk.type):
            shape.append(chunk.type.list_size)
            chunk = chunk.flatten()
        elif pa.types.is_list(chunk.type) or pa.types.is_large_list(chunk.type):
            lengths = np.diff(chunk.offsets.to_numpy())
            if not len(lengths) or (lengths != lengths[0]).any():
                return None
            shape.append(int(lengths[0]))
            chunk = chunk.flatten()
        else:
            break
    is_number = pa.types.is_float32(chunk.type) or pa.types.is_float64(chunk.type) or pa.types.is_boolean(chunk.type)
    is_number = is_number or (pa.types.is_integer(chunk.type) and chunk.type != pa.uint64())
    if not is_number or not math.prod(shape):
        return None
    values: NDArray[Any] = chunk.to_numpy(zero_copy_only=False)
    return values.reshape(shape)
