"""Features of a dataset in the form of external recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from demorec.datasets.lerobot.depth import DepthScale
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetFeature
from demorec.episode.element_names import numbers
from demorec.episode.features import IMAGE_PREFIX
from demorec.episode.info import Feature

_MAX_ELEMENTS = 4096
_RECORDED: Mapping[str, Literal["float32", "float64"]] = {
    **dict.fromkeys(("bool", "int8", "uint8", "int16", "uint16", "float16", "float32"), "float32"),
    **dict.fromkeys(("int32", "uint32", "int64", "uint64", "float64"), "float64"),
}
"""Type of a column -> recording type that holds all its values, except the largest integers."""
NOT_HELD = "imported recordings hold none"
_NEXT: Mapping[str, str] = {
    "next.success": "its last value becomes the outcome of the episode",
    "next.done": "an export computes it again: true in the last row of an episode",
    "next.reward": "imported recordings hold an outcome, and no rewards",
}
"""Columns of LeRobot's environments -> their treatment in an import."""


def camera_name(key: str) -> str:
    """Name the camera of a feature: "top" for "observation.images.top", "image" for "observation.image"."""
    return key.removeprefix(IMAGE_PREFIX).removeprefix("observation.").replace(".", "_")


def why_not_recorded(name: str, feature: DatasetFeature) -> str:
    """Reason why a feature is not recorded, "" if it is."""
    if name in AUTOMATIC_FEATURES:
        return ""
    if name.startswith("next."):
        return _NEXT.get(name, NOT_HELD)
    if feature.is_depth:
        return _why_no_distances(feature)
    if feature.dtype in ("video", "image"):
        return ""
    if feature.dtype not in _RECORDED:
        return f"it is {feature.dtype}, and recordings of other robots hold numbers"
    if feature.shape[0] > _MAX_ELEMENTS:
        return f"it has {feature.shape[0]:,} numbers a row, and recordings of other robots hold up to {_MAX_ELEMENTS:,}"
    if len(feature.shape) > 1:
        return f"it is an array of {'x'.join(map(str, feature.shape))}, and recordings of other robots hold vectors"
    return ""


def _why_no_distances(feature: DatasetFeature) -> str:
    """Reason why the distances of a depth feature cannot be read, "" if they can."""
    if not feature.is_video:
        return "its depth is in images, and depth is read from videos"
    try:
        DepthScale.of(feature.info or {})
    except ValueError as error:
        return str(error)
    return ""


def recorded_feature(name: str, feature: DatasetFeature, elements: Sequence[str]) -> Feature:
    """Describe a numeric feature with these elements, in recordings' type."""
    count = int(np.prod(feature.shape))
    names = tuple(name.replace(",", " ") for name in elements)
    if len(set(names)) != count:
        names = numbers(count)
    return Feature(name=name, dtype=_RECORDED[feature.dtype], names=names, source=name)
