"""GR00T's `meta/modality.json`: which elements of which features are the state, the action, or an annotation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from demorec.core.errors import ExportError, describe_error
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.episode.element_names import numbers
from demorec.episode.features import ACTION, STATE
from demorec.episode.roles import Modality, NamedRoles, Roles, find_roles

MODALITY_PATH = "meta/modality.json"
_DEFAULT_FEATURES = {"state": STATE, "action": ACTION}
"""Section -> feature of its groups, unless they name another one as original_key."""


class _Group(NamedTuple):
    """Elements `first` to `last` - 1 of a feature."""

    feature: str
    name: str
    first: int
    last: int


def dataset_roles(root: Path, info: DatasetInfo, named: NamedRoles) -> Roles:
    """The role of each feature of a dataset.

    Args:
        root: The dataset's folder.
        info: Content of info.json.
        named: Roles that the user names.

    Raises:
        ConfigError: As in `find_roles`.
        ExportError: modality.json is damaged.
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
        feature, first, last = (
            entry.get("original_key") or _DEFAULT_FEATURES[name],
            entry.get("start"),
            entry.get("end"),
        )
        if not isinstance(feature, str) or type(first) is not int or type(last) is not int:
            raise ValueError(f"the group {group!r} of {name} has no start, end or feature")
        yield _Group(feature, group, first, last)


def _elements(groups: list[_Group], info: DatasetInfo) -> dict[str, tuple[str, ...]]:
    """Feature -> names of its elements, for elements in a group."""
    found: dict[str, list[str]] = {}
    for group in groups:
        feature = info.features.get(group.feature)
        if feature is None or len(feature.shape) != 1:
            continue
        names = found.setdefault(group.feature, list(numbers(feature.shape[0])))
        for place in range(max(group.first, 0), min(group.last, len(names))):
            names[place] = group.name if group.last - group.first == 1 else f"{group.name}.{place - group.first}"
    return {feature: tuple(names) for feature, names in found.items()}
