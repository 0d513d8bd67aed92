"""Exact statistics over all rows of the data files, in memory that does not grow with them.

LeRobot averages the quantiles of the episodes, which is wrong for a dataset (the mean of medians is no median).
Here the order statistics themselves are found, by radix selection: values become integers of the same order, and
each of three passes over the files counts how often the next 11 (11, 10) bits occur among the candidates left. The
counters have the same size for ten rows and for ten million.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from demorec.errors import ExportError
from demorec.geometry import Array
from demorec.lerobot.files import table_batches
from demorec.lerobot.layout import Feature
from demorec.lerobot.stats import QUANTILES, Statistics, quantile_ranks

_BATCH_ROWS = 2048
_LEVELS = ((21, 11), (10, 11), (0, 10))
"""(shift, bits) of what each pass looks at, of a 32-bit key."""


def data_statistics(files: Iterable[Path], features: Mapping[str, Feature]) -> dict[str, Statistics]:
    """Feature -> statistics over all rows.

    Args:
        files: Parquet files with the columns of `features`.
        features: All features; what is no numbers is left out.

    Raises:
        ExportError: A column holds integers below 0 or above 2^32 - 1, what is no number, or no rows at all.
    """
    paths = list(files)
    names = [name for name, feature in features.items() if feature.is_numeric]
    widths = [features[name].shape[0] for name in names]
    moments = _Moments()
    selection: _Selection | None = None
    for level in range(len(_LEVELS)):
        for arrays in _batches(paths, names):
            if any(array.dtype.kind not in "fiub" for array in arrays):  # nulls, or lists of several lengths
                raise ExportError("A column of the dataset holds values that are no numbers, so it has no statistics.")
            if level == 0:
                moments.add(np.concatenate(arrays, axis=1, dtype=np.float64))
            keys = np.concatenate([_ordered_keys(array) for array in arrays], axis=1)
            if selection is None:
                selection = _Selection(keys.shape[1])
            selection.count(keys, level)
        if selection is None:
            raise ExportError("The dataset has no rows, so it has no statistics.")
        selection.narrow(level, moments.count)
    assert selection is not None
    values = moments.values()
    is_float = np.repeat([features[name].dtype == "float32" for name in names], widths)
    low, high = selection.order_statistics(is_float)
    for index, (name, q) in enumerate(QUANTILES.items()):
        weight = quantile_ranks(q, moments.count)[2]
        values[name] = low[:, index] + (high[:, index] - low[:, index]) * weight
    result = {}
    start = 0
    for name, width in zip(names, widths, strict=True):
        part = {key: value[start : start + width] for key, value in values.items()}
        result[name] = Statistics(values=part, count=moments.count)
        start += width
    return result


def _batches(paths: Sequence[Path], names: list[str]) -> Iterator[list[NDArray[Any]]]:
    for path in paths:
        for batch in table_batches(path, names, rows=_BATCH_ROWS):
            yield [column_numbers(batch.column(name)) for name in names]


def column_numbers(column: pa.Array) -> NDArray[Any]:
    """(T, D) numbers of a data column, D = 1 for a scalar one."""
    if pa.types.is_fixed_size_list(column.type) or pa.types.is_list(column.type):
        flat = column.flatten().to_numpy(zero_copy_only=False)
        return np.asarray(flat).reshape(len(column), -1)
    return np.asarray(column.to_numpy(zero_copy_only=False)).reshape(-1, 1)


class _Moments:
    """Minimum, maximum, mean and standard deviation, batch by batch (Chan, Golub and LeVeque 1979)."""

    def __init__(self) -> None:
        self.count = 0
        self._mean: Array = np.zeros(0)
        self._squares: Array = np.zeros(0)
        self._min: Array = np.zeros(0)
        self._max: Array = np.zeros(0)

    def add(self, values: Array) -> None:
        rows = len(values)
        mean = values.mean(axis=0)
        squares = ((values - mean) ** 2).sum(axis=0)
        if self.count == 0:
            self._mean, self._squares = mean, squares
            self._min, self._max = values.min(axis=0), values.max(axis=0)
        else:
            delta = mean - self._mean
            total = self.count + rows
            self._squares = self._squares + squares + delta * delta * (self.count * rows / total)
            self._mean = self._mean + delta * (rows / total)
            self._min = np.minimum(self._min, values.min(axis=0))
            self._max = np.maximum(self._max, values.max(axis=0))
        self.count += rows

    def values(self) -> dict[str, Array]:
        return {
            "min": self._min,
            "max": self._max,
            "mean": self._mean,
            "std": np.sqrt(self._squares / self.count),
        }


def _ordered_keys(values: NDArray[Any]) -> NDArray[np.uint32]:
    """32-bit integers in the order of the values."""
    if values.dtype == np.float32:
        bits = np.ascontiguousarray(values).view(np.uint32)
        sign = np.uint32(0x80000000)
        return np.where(bits & sign, ~bits, bits | sign)
    if values.dtype.kind in "biu":
        if values.dtype.kind != "b" and len(values) and (values.min() < 0 or values.max() > 0xFFFFFFFF):
            raise ExportError(
                f"An integer column runs from {values.min()} to {values.max()}, allowed is 0 to 2^32 - 1."
            )
        return values.astype(np.uint32)
    raise ExportError(f"Statistics of a column of type {values.dtype} are unknown.")


def _values_of_keys(keys: NDArray[np.uint32], is_float: NDArray[np.bool_]) -> Array:
    sign = np.uint32(0x80000000)
    bits = np.where(keys & sign, keys ^ sign, ~keys)
    return np.where(is_float[:, np.newaxis], bits.view(np.float32).astype(np.float64), keys.astype(np.float64))


class _Selection:
    """Finds, for every column, the two order statistics around every quantile."""

    def __init__(self, columns: int) -> None:
        self._columns = columns
        self._ranks = 2 * len(QUANTILES)
        # Candidates of the level are told apart by a slot; ranks whose keys agree so far share one.
        self._slot_of_rank = np.zeros((columns, self._ranks), dtype=np.int64)
        self._residual = np.zeros((columns, self._ranks), dtype=np.int64)
        self._keys = np.zeros((columns, self._ranks), dtype=np.uint32)
        self._lookups: list[NDArray[np.int8]] = []
        self._counts = np.zeros((columns, 1, 1 << _LEVELS[0][1]), dtype=np.int64)

    def count(self, keys: NDArray[np.uint32], level: int) -> None:
        """Count the bits of this level among the candidates in a batch (rows, columns)."""
        column = np.broadcast_to(np.arange(self._columns), keys.shape).ravel()
        flat = keys.ravel()
        slot = np.zeros(len(flat), dtype=np.int64)
        for (shift, bits), lookup in zip(_LEVELS, self._lookups, strict=False):
            slot = lookup[column, slot, (flat >> np.uint32(shift)) & np.uint32((1 << bits) - 1)].astype(np.int64)
            chosen = slot >= 0
            column, flat, slot = column[chosen], flat[chosen], slot[chosen]
        shift, bits = _LEVELS[level]
        part = (flat >> np.uint32(shift)) & np.uint32((1 << bits) - 1)
        slots = self._counts.shape[1]
        np.add.at(self._counts.reshape(-1), ((column * slots + slot) << bits) + part, 1)

    def narrow(self, level: int, total: int) -> None:
        """After a pass: find the bits of every rank and set up the counters of the next pass."""
        if level == 0:
            ranks = [rank for q in QUANTILES.values() for rank in quantile_ranks(q, total)[:2]]
            self._residual[:] = ranks
        shift, bits = _LEVELS[level]
        lookup = np.full((self._columns, self._counts.shape[1], 1 << bits), -1, dtype=np.int8)
        for column in range(self._columns):
            cumulative = np.cumsum(self._counts[column], axis=1)
            for rank in range(self._ranks):
                slot = self._slot_of_rank[column, rank]
                chosen = int(np.searchsorted(cumulative[slot], self._residual[column, rank], side="right"))
                if chosen:
                    self._residual[column, rank] -= cumulative[slot, chosen - 1]
                self._keys[column, rank] |= np.uint32(chosen << shift)
                if lookup[column, slot, chosen] < 0:
                    lookup[column, slot, chosen] = rank
                self._slot_of_rank[column, rank] = lookup[column, slot, chosen]
        self._lookups.append(lookup)
        if level + 1 < len(_LEVELS):
            self._counts = np.zeros((self._columns, self._ranks, 1 << _LEVELS[level + 1][1]), dtype=np.int64)

    def order_statistics(self, is_float: NDArray[np.bool_]) -> tuple[Array, Array]:
        """(columns, quantiles) lower and upper neighbour of every quantile."""
        values = _values_of_keys(self._keys, is_float)
        return values[:, 0::2], values[:, 1::2]
