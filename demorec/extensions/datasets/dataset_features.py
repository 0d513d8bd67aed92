"""Features of a dataset: their roles, also by GR00T's `meta/modality.json`, and their form in external recordings."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from demorec.core.errors import ExportError, describe_error
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetFeature, DatasetInfo
from demorec.episode.element_names import numbers
from demorec.episode.features import ACTION, IMAGE_PREFIX, STATE
from demorec.episode.info import Feature
from demorec.episode.roles import Modality, NamedRoles, Roles, find_roles

MODALITY_PATH = "meta/modality.json"
_DEFAULT_FEATURES = {"state": STATE, "action": ACTION}
"""Section -> feature of its groups, unless they name another one as original_key."""
_MAX_ELEMENTS = 4096
_RECORDED: Mapping[str, Literal["float32", "float64"]] = {
    **dict.fromkeys(("bool", "int8", "uint8", "int16", "uint16", "float16", "float32"), "float32"),
    **dict.fromkeys(("int32", "uint32", "int64", "uint64", "float64"), "float64"),
}
"""Type of a column -> recording type that holds all its values, except the largest integers."""
NOT_HELD = "imported recordings hold none"

_TASK_WORD = re.compile(r"(^|[._])(annotations?|tasks?|subtasks?)([._]|$)")


class _Group(NamedTuple):
    """Elements `first` to `last` - 1 of a feature."""

    feature: str
    name: str
    first: int
    last: int


def dataset_roles(root: Path, info: DatasetInfo, named: NamedRoles) -> Roles:
    """The role of each feature; `named` are the user's. Raises ConfigError as in `find_roles`, and ExportError if
    modality.json is damaged.
    """
    columns = {name: feature.column for name, feature in info.features.items()}
    return find_roles(columns, named, read_modality(root, info))


def read_modality(root: Path, info: DatasetInfo) -> Modality:
    """Read the features' groups from modality.json, none if it is missing; ExportError if it is damaged."""
    path = root / MODALITY_PATH
    if not path.exists():
        return Modality()
    try:
        data = read_json(path)
        groups = {section: list(_groups(data.get(section) or {}, section)) for section in _DEFAULT_FEATURES}
        labels = [str(entry.get("original_key") or f"annotation.{name}") for name, entry in _items(data, "annotation")]
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise ExportError(f"{MODALITY_PATH} of the dataset is damaged ({describe_error(error)}): {root}") from error
    return Modality(
        state=tuple(dict.fromkeys(group.feature for group in groups["state"])),
        action=tuple(dict.fromkeys(group.feature for group in groups["action"])),
        labels=tuple(labels),
        elements=_elements([*groups["state"], *groups["action"]], info),
    )


def _items(data: Mapping[str, Any], section: str) -> list[tuple[str, Mapping[str, Any]]]:
    return [(name, entry or {}) for name, entry in (data.get(section) or {}).items()]


def _groups(section: Mapping[str, Any], name: str) -> Iterator[_Group]:
    for group, entry in section.items():
        feature = entry.get("original_key") or _DEFAULT_FEATURES[name]
        first, last = entry.get("start"), entry.get("end")
        if not isinstance(feature, str) or type(first) is not int or type(last) is not int:
            raise ValueError(f"the group {group!r} of {name} has no start, end or feature")
        yield _Group(feature, group, first, last)


def _elements(groups: list[_Group], info: DatasetInfo) -> dict[str, tuple[str, ...]]:
    found: dict[str, list[str]] = {}
    for group in groups:
        feature = info.features.get(group.feature)
        if feature is None or len(feature.shape) != 1:
            continue
        names = found.setdefault(group.feature, list(numbers(feature.shape[0])))
        for place in range(max(group.first, 0), min(group.last, len(names))):
            names[place] = group.name if group.last - group.first == 1 else f"{group.name}.{place - group.first}"
    return {feature: tuple(names) for feature, names in found.items()}


def is_task_reference(name: str, feature: DatasetFeature) -> bool:
    """Whether a feature may refer to tasks by number: an integer column with a name like GR00T's `annotation.*`."""
    is_number = feature.dtype.startswith(("int", "uint")) and feature.shape == (1,)
    return is_number and name not in AUTOMATIC_FEATURES and _TASK_WORD.search(name) is not None


def camera_name(key: str) -> str:
    """Name the camera of a feature: "top" for "observation.images.top", "image" for "observation.image"."""
    return key.removeprefix(IMAGE_PREFIX).removeprefix("observation.").replace(".", "_")


def why_not_recorded(name: str, feature: DatasetFeature) -> str:
    """Reason why a feature is not recorded, "" if it is."""
    if name in AUTOMATIC_FEATURES:
        return ""
    if name.startswith("next."):
        return "recordings hold an outcome instead"
    if feature.is_depth:
        return _why_no_distances(feature)
    if feature.dtype in ("video", "image"):
        return ""
    if feature.dtype not in _RECORDED or len(feature.shape) > 1 or feature.shape[0] > _MAX_ELEMENTS:
        kind = f"{feature.dtype} of shape {'x'.join(map(str, feature.shape))}"
        return f"it holds {kind}, and recordings of other robots hold vectors of up to {_MAX_ELEMENTS:,} numbers"
    return ""


def _why_no_distances(feature: DatasetFeature) -> str:
    from demorec.extensions.datasets.videos import depth_scale_of  # loads libav

    if not feature.is_video:
        return "its depth is in images, and depth is read from videos"
    try:
        depth_scale_of(feature.info or {})
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
