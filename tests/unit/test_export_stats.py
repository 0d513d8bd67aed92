"""Statistics against NumPy: of episodes, of images, and of data files in bounded memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from demorec.datasets.lerobot.layout import DatasetFeature, data_schema
from demorec.datasets.lerobot.stats import (
    QUANTILES,
    Statistics,
    data_statistics,
)


def check(found: Statistics, column: NDArray[np.generic]) -> None:
    values = column.astype(np.float64).reshape(len(column), -1)
    assert found.count == len(values)
    assert np.array_equal(found.values["min"], values.min(axis=0))
    assert np.array_equal(found.values["max"], values.max(axis=0))
    assert np.allclose(found.values["mean"], values.mean(axis=0), rtol=1e-9, atol=1e-12)
    assert np.allclose(found.values["std"], values.std(axis=0), rtol=1e-9, atol=1e-12)
    for name, q in QUANTILES.items():
        assert np.allclose(found.values[name], np.quantile(values, q, axis=0), rtol=1e-12, atol=1e-45), name


def columns(rng: np.random.Generator, count: int) -> dict[str, NDArray[np.generic]]:
    state = rng.normal(size=(count, 6)).astype(np.float32)
    state[:, 1] = 0.25  # constant
    state[:, 2] = np.round(state[:, 2])  # many ties
    state[:, 3] *= np.float32(1e-40)  # denormal
    state[:, 4] *= np.float32(1e30)
    state[::2, 5] = -0.0
    return {
        "state": state,
        "reward": rng.random(count).astype(np.float32),
        "done": rng.random(count) < 0.3,
        "index": rng.integers(-(2**40), 2**40, count),
    }


def write(path: Path, data: dict[str, NDArray[np.generic]], *, row_group: int) -> dict[str, DatasetFeature]:
    features = {
        "state": DatasetFeature(dtype="float32", shape=(6,)),
        "camera": DatasetFeature(dtype="video", shape=(4, 4, 3)),
        "reward": DatasetFeature(dtype="float32", shape=(1,)),
        "done": DatasetFeature(dtype="bool", shape=(1,)),
        "index": DatasetFeature(dtype="int64", shape=(1,)),
    }
    schema = data_schema(features)
    state = pa.FixedSizeListArray.from_arrays(pa.array(data["state"].reshape(-1)), type=schema.field("state").type)
    arrays = [state, *(pa.array(data[name]) for name in ("reward", "done", "index"))]
    pq.write_table(pa.Table.from_arrays(arrays, schema=schema), path, row_group_size=row_group)
    return features


@pytest.mark.parametrize("count", [1, 2, 3, 100, 2049, 9000])
def test_statistics_of_files_equal_those_of_numpy(tmp_path: Path, count: int) -> None:
    rng = np.random.default_rng(count)
    data = columns(rng, count)
    cut = count // 3
    parts = [
        part
        for part in ({k: v[:cut] for k, v in data.items()}, {k: v[cut:] for k, v in data.items()})
        if len(part["index"])
    ]
    paths = [tmp_path / f"{number}.parquet" for number in range(len(parts))]
    for path, part in zip(paths, parts, strict=True):
        features = write(path, part, row_group=77)
    found = data_statistics(paths, features)
    assert set(found) == set(data)
    for name, column in data.items():
        check(found[name], column)
