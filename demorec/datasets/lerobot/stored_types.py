"""Types in the data files, which may differ from info.json."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from demorec.datasets.lerobot.files import open_table
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, NUMBER_TYPES, FeatureType

_NAMES = {"halffloat": "float16", "float": "float32", "double": "float64", "large_string": "string"}
"""Arrow's type names -> LeRobot's, if different."""


def mistyped_features(source: LeRobotFolder) -> dict[str, FeatureType]:
    """Find numeric features whose type in the data files differs from info.json -> the files' type.

    If files differ, it is the type that holds all their numbers.
    """
    numeric = {name: feature for name, feature in source.info.features.items() if feature.is_numeric}
    stored: dict[str, set[str]] = {}
    for path in source.data_tables:
        schema = open_table(path).schema_arrow
        for name in numeric:
            if name in schema.names:
                stored.setdefault(name, set()).add(stored_dtype(schema.field(name).type))
    found: dict[str, FeatureType] = {}
    for name, dtypes in stored.items():
        if name in AUTOMATIC_FEATURES and name != "timestamp":
            continue
        if dtypes <= set(NUMBER_TYPES) and dtypes != {numeric[name].dtype}:
            found[name] = str(np.result_type(*dtypes))  # type: ignore[assignment]
    return found


def stored_dtype(column: pa.DataType) -> str:
    """Return LeRobot's name of the type in a column of numbers, texts, lists or arrays."""
    if isinstance(column, pa.BaseExtensionType):
        column = column.storage_type
    while pa.types.is_list(column) or pa.types.is_fixed_size_list(column) or pa.types.is_large_list(column):
        column = column.value_type
    return _NAMES.get(str(column), str(column))
