"""LeRobot's ten statistics of each feature, computed exactly: of vectors from the values, of images from histograms.

LeRobot estimates quantiles from histograms with 5,000 bins; here they equal `numpy.quantile`.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.core.geometry import Array
from demorec.datasets.lerobot.files import column_numbers, open_table, table_batches
from demorec.datasets.lerobot.layout import DatasetFeature

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
NAMES = ("min", "max", "mean", "std", "count", *QUANTILES)


@dataclass(frozen=True, kw_only=True, eq=False)
class Statistics:
    """The ten statistics of one feature.

    Attributes:
        values: Every name in `NAMES` except "count" -> (D,) float64.
        count: Number of frames.
        is_camera: Whether the arrays have the shape (channels, 1, 1) in LeRobot's files.
    """

    values: Mapping[str, Array]
    count: int
    is_camera: bool = False

    def nested(self, name: str) -> list[Any]:
        """One statistic in LeRobot's form."""
        if name == "count":
            return [self.count]
        numbers = self.values[name].tolist()
        return [[[number]] for number in numbers] if self.is_camera else numbers

    def to_json(self) -> dict[str, list[Any]]:
        """All statistics in LeRobot's form."""
        return {name: self.nested(name) for name in NAMES}


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelHistogram:
    """Count of each level in each channel.

    Attributes:
        counts: (channels, levels) int64.
        level_values: (levels,) value of each level: 0..1 for colour, metres for depth.
        num_images: Number of images counted.
    """

    counts: NDArray[np.int64]
    level_values: Array
    num_images: int

    def __add__(self, other: PixelHistogram) -> PixelHistogram:
        return replace(self, counts=self.counts + other.counts, num_images=self.num_images + other.num_images)

    def statistics(self) -> Statistics:
        """Exact statistics over all counted pixels."""
        channels = [_of_levels(counts, self.level_values) for counts in self.counts]
        values = {name: np.array([channel[name] for channel in channels]) for name in NAMES if name != "count"}
        return Statistics(values=values, count=self.num_images, is_camera=True)


def _of_levels(counts: NDArray[np.int64], levels: Array) -> dict[str, float]:
    total = int(counts.sum())
    present = np.flatnonzero(counts)
    mean = float((counts * levels).sum() / total)
    deviation = levels - mean
    result = {
        "min": float(levels[present[0]]),
        "max": float(levels[present[-1]]),
        "mean": mean,
        "std": math.sqrt(float((counts * deviation * deviation).sum() / total)),
    }
    cumulative = np.cumsum(counts)
    for name, q in QUANTILES.items():
        low, high, weight = quantile_ranks(q, total)
        a, b = (float(levels[np.searchsorted(cumulative, rank, side="right")]) for rank in (low, high))
        result[name] = a + (b - a) * weight
    return result


def colour_levels() -> Array:
    """Values of the 256 levels of a colour channel, 0..1."""
    return np.arange(256) / 255.0


def vector_statistics(columns: Mapping[str, NDArray[Any]]) -> dict[str, Statistics]:
    """Statistics of the columns (T,) or (T, D) of one episode by feature, in one sort over all components."""
    blocks = {name: column.reshape(len(column), -1) for name, column in columns.items()}
    matrix = np.concatenate([block.T for block in blocks.values()], axis=0, dtype=np.float64)  # (components, T)
    count = matrix.shape[1]
    mean = matrix.mean(axis=1)
    std = np.sqrt(((matrix - mean[:, None]) ** 2).mean(axis=1))
    ordered = np.sort(matrix, axis=1)
    values = {"min": ordered[:, 0], "max": ordered[:, -1], "mean": mean, "std": std}
    for name, q in QUANTILES.items():
        low, high, weight = quantile_ranks(q, count)
        values[name] = ordered[:, low] + (ordered[:, high] - ordered[:, low]) * weight
    result = {}
    start = 0
    for name, block in blocks.items():
        end = start + block.shape[1]
        result[name] = Statistics(values={key: value[start:end] for key, value in values.items()}, count=count)
        start = end
    return result


def quantile_ranks(q: float, count: int) -> tuple[int, int, float]:
    """The two order statistics around the quantile, and the weight of the upper one (as NumPy)."""
    position = q * (count - 1)
    low = int(position)
    return low, min(low + 1, count - 1), position - low


def merge_statistics(parts: Sequence[Statistics]) -> Statistics:
    """Merge statistics of sets of images: exact except for the quantiles, which are averaged as in LeRobot."""
    if len(parts) == 1:
        return parts[0]
    counts = np.array([part.count for part in parts], dtype=np.float64)
    weights = counts / counts.sum()

    def weighted(name: str) -> NDArray[np.float64]:
        return np.asarray(sum(w * part.values[name] for w, part in zip(weights, parts, strict=True)))

    mean = weighted("mean")
    variance = sum(
        w * (part.values["std"] ** 2 + (part.values["mean"] - mean) ** 2)
        for w, part in zip(weights, parts, strict=True)
    )
    values = {name: weighted(name) for name in NAMES if name.startswith("q")}
    values["min"] = np.min([part.values["min"] for part in parts], axis=0)
    values["max"] = np.max([part.values["max"] for part in parts], axis=0)
    values["mean"], values["std"] = mean, np.sqrt(np.asarray(variance))
    return Statistics(values=values, count=int(counts.sum()), is_camera=parts[0].is_camera)


_BATCH_ROWS = 2048


def data_statistics(files: Sequence[Path], features: Mapping[str, DatasetFeature]) -> dict[str, Statistics]:
    """Feature -> statistics over all rows of Parquet files; for arrays of several dimensions along the last one, as in
    LeRobot. Raises ExportError if a numeric column holds values that are not numbers, or has no rows.
    """
    numeric = {name: feature.shape for name, feature in features.items() if feature.is_numeric}
    return {name: _stored_statistics(files, name, shape) for name, shape in numeric.items()}


def _stored_statistics(files: Sequence[Path], name: str, shape: tuple[int, ...]) -> Statistics:
    """Statistics of one feature, from one element of all vectors at a time."""
    rows = sum(open_table(path).metadata.num_rows for path in files)
    if not rows:
        raise ExportError("The dataset has no rows, so it has no statistics.")
    width, count = shape[-1], rows * math.prod(shape[:-1])
    # In a file next to the data: /tmp may be in memory.
    with tempfile.TemporaryFile(dir=files[0].parent, buffering=0) as file:
        start = 0
        for batch in chain.from_iterable(table_batches(path, [name], rows=_BATCH_ROWS) for path in files):
            numbers = column_numbers(batch.column(name))
            if numbers.dtype.kind not in "fiub":  # nulls, or lists of different lengths
                raise ExportError("A column of the dataset holds values that are not numbers, so it has no statistics.")
            vectors = numbers.reshape(-1, width).astype(np.float64)
            for index, element in enumerate(vectors.T):
                file.seek((index * count + start) * element.itemsize)
                file.write(element.tobytes())
            start += len(vectors)
        file.seek(0)
        elements = [vector_statistics({name: np.fromfile(file, np.float64, count)})[name] for _ in range(width)]
    values = {key: np.concatenate([element.values[key] for element in elements]) for key in elements[0].values}
    return Statistics(values=values, count=rows)
