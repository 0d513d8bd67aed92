"""Exact statistics over all rows of the data files, in memory that does not grow with their columns.

LeRobot averages the quantiles of the episodes, which is wrong for a dataset (the mean of medians is no median).
Here the order statistics themselves are found, one component at a time. What is in memory of all rows is that
component alone; the other components of its feature wait in a file without a name.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.core.geometry import Array
from demorec.datasets.lerobot.files import table_batches
from demorec.datasets.lerobot.layout import DatasetFeature
from demorec.datasets.lerobot.stats import QUANTILES, Statistics, quantile_ranks

_BATCH_ROWS = 2048


def data_statistics(files: Iterable[Path], features: Mapping[str, DatasetFeature]) -> dict[str, Statistics]:
    """Feature -> statistics over all rows.

    Args:
        files: Parquet files with the columns of `features`.
        features: All features; what is no numbers is left out.

    Raises:
        ExportError: A column holds what is no number, or no rows at all.
    """
    paths = list(files)
    names = [name for name, feature in features.items() if feature.is_numeric]
    moments = _Moments()
    for arrays in _batches(paths, names):
        if any(array.dtype.kind not in "fiub" for array in arrays):  # nulls, or lists of several lengths
            raise ExportError("A column of the dataset holds values that are no numbers, so it has no statistics.")
        moments.add(np.concatenate(arrays, axis=1, dtype=np.float64))
    if not moments.count:
        raise ExportError("The dataset has no rows, so it has no statistics.")
    values = moments.values()
    result = {}
    start = 0
    for name in names:
        width = features[name].shape[0]
        part = {key: value[start : start + width] for key, value in values.items()}
        part |= _quantiles(paths, name, (width, moments.count))
        result[name] = Statistics(values=part, count=moments.count)
        start += width
    return result


def _quantiles(paths: Sequence[Path], name: str, shape: tuple[int, int]) -> dict[str, Array]:
    """Quantile -> (D,) of one feature of `shape` (D, T)."""
    ranks = {key: quantile_ranks(q, shape[1]) for key, q in QUANTILES.items()}
    wanted = sorted({rank for low, high, _ in ranks.values() for rank in (low, high)})
    found = np.empty((shape[0], len(wanted)))
    # One component after another, in a file beside the data: /tmp may be memory.
    with tempfile.TemporaryFile(dir=paths[0].parent, buffering=0) as file:
        start = 0
        for (array,) in _batches(paths, [name]):
            for index, part in enumerate(array.T):
                file.seek((index * shape[1] + start) * array.itemsize)
                file.write(part.tobytes())
            start += len(array)
        file.seek(0)
        for values in found:
            values[:] = np.partition(np.fromfile(file, array.dtype, shape[1]), wanted)[wanted]
    place = {rank: found[:, index] for index, rank in enumerate(wanted)}
    return {key: place[low] + (place[high] - place[low]) * weight for key, (low, high, weight) in ranks.items()}


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
