"""Merge datasets: match features by name, report all differences at once, and resolve them by a mapping (TOML).

[[dataset]]
path = "b"                                  # as on the command line
robot_type = "so100"                        # name of its arm in the merged dataset
drop = ["observation.images.side"]

[dataset.feature."observation.state"]       # a feature of the merged dataset
from = "state"                              # its name in this one
elements = ["shoulder", "gripper"]          # names in this one, in the order of the first dataset
unit = "degree"                             # here: rad (unchanged), degree, or normalised, with low and high in rad
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.errors import ConfigError, describe_error
from demorec.core.files import read_text_limited
from demorec.core.registry import check_choice
from demorec.datasets.lerobot.layout import DatasetFeature
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.plan import FeatureMapping, Plan

_UNITS = ("rad", "degree", "normalised")
_MAX_BYTES = 1 << 20
_KEYS = ("path", "robot_type", "drop", "feature")
_FEATURE_KEYS = ("from", "elements", "unit", "low", "high")


def mapped_plans(sources: Sequence[LeRobotFolder], mapping: Path | None) -> list[Plan]:
    """Plan each dataset as the mapping describes it; ConfigError if the mapping cannot be used."""
    if len(sources) < 2:
        raise ConfigError("Name two or more datasets to merge.")
    entries = {} if mapping is None else _read(mapping, [source.root for source in sources])
    plans: list[Plan] = []
    for source in sources:
        try:
            entry = entries.get(source.root.resolve(), {})
            plans.append(_mapped(Plan.whole(source), entry, plans[0] if plans else None))
        except (ConfigError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise ConfigError(
                f"The mapping of {source.root} cannot be used ({describe_error(error)}): {mapping}"
            ) from error
    return plans


def differences(plans: Sequence[Plan]) -> list[str]:
    """Describe the differences that prevent a merge."""
    return [text for plan in plans[1:] for text in _differences(plans[0], plan)]


def joined(plans: Sequence[Plan]) -> Plan:
    """Concatenate plans of one source each with the same features."""
    cuts = [replace(cut, source=number) for number, plan in enumerate(plans) for cut in plan.cuts]
    others = [plan.info.other for plan in plans]
    shared = {name: value for name, value in others[0].items() if all(other.get(name) == value for other in others)}
    return Plan(
        sources=tuple(source for plan in plans for source in plan.sources),
        cuts=tuple(cuts),
        info=replace(plans[0].info, other=shared),
        mappings=tuple({name: plan.mappings[0][name] for name in plans[0].mappings[0]} for plan in plans),
    )


def _read(path: Path, roots: Sequence[Path]) -> dict[Path, dict[str, Any]]:
    try:
        data = tomllib.loads(read_text_limited(path, _MAX_BYTES))
        found = data.get("dataset", [])
        entries = {Path(entry["path"]).resolve(): dict(entry) for entry in found}
        if set(data) - {"dataset"}:
            raise ValueError(f"it has the unknown key {sorted(set(data) - {'dataset'})[0]!r}")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ConfigError(f"The mapping cannot be used ({describe_error(error)}): {path}") from error
    if strange := [entry for entry in entries if entry not in [root.resolve() for root in roots]]:
        raise ConfigError(f"The mapping names a dataset that is not merged, {strange[0]}: {path}")
    return entries


def _mapped(plan: Plan, entry: Mapping[str, Any], first: Plan | None) -> Plan:
    """Plan a dataset by its entry in the mapping."""
    for key in entry:
        check_choice("key of a mapping", key, _KEYS)
    if dropped := entry.get("drop"):
        plan = plan.without_features(dropped)
    wanted = entry.get("feature", {})
    plan = plan.renamed({item["from"]: name for name, item in wanted.items() if item.get("from", name) != name})
    features, mappings = dict(plan.info.features), dict(plan.mappings[0])
    for name, item in wanted.items():
        for key in item:
            check_choice("key of a feature in a mapping", key, _FEATURE_KEYS)
        if set(item) - {"from"}:
            model = features[name] if first is None else first.info.features.get(name, features[name])
            features[name], mappings[name] = _converted(features[name], mappings[name], item, model)
    plan = plan.with_features(features, mappings)
    return replace(plan, info=replace(plan.info, robot_type=entry.get("robot_type", plan.info.robot_type)))


def _converted(
    own: DatasetFeature, mapping: FeatureMapping, item: Mapping[str, Any], model: DatasetFeature
) -> tuple[DatasetFeature, FeatureMapping]:
    """A converted feature of the merged dataset, which has one like `model`, and its mapping."""
    if not all(feature.is_numeric and len(feature.shape) == 1 for feature in (own, model)):
        raise ValueError("only vectors of numbers are converted")
    elements = None
    if "elements" in item:
        elements = tuple(own.elements.index(text) for text in item["elements"])
        if model is own:
            model = replace(own, shape=(len(elements),), names=tuple(item["elements"]), written_names=None)
    width = own.shape[0] if elements is None else len(elements)
    if width != model.shape[0]:
        raise ValueError(f"it has a different number of elements than {model.shape[0]}")
    scale, offset = _unit(item, width)
    return model, replace(mapping, elements=elements, scale=scale, offset=offset)


def _unit(item: Mapping[str, Any], width: int) -> tuple[Any, Any]:
    """(D,) factor and offset that convert an entry's unit to rad; None for rad."""
    unit = check_choice("unit", str(item.get("unit", "rad")), _UNITS)
    if unit == "rad":
        return None, None
    if unit == "degree":
        return np.full(width, math.pi / 180), np.zeros(width)
    low = np.broadcast_to(np.asarray(item["low"], dtype=np.float64), (width,))
    high = np.broadcast_to(np.asarray(item["high"], dtype=np.float64), (width,))
    return (high - low) / 200, (high + low) / 2  # LeRobot's range of a joint is -100 to 100


def _differences(a: Plan, b: Plan) -> Iterator[str]:
    root = b.sources[0].root
    if a.info.fps != b.info.fps:
        yield f"{root} has {b.info.fps} frames a second, not {a.info.fps}, which no mapping resolves"
    if a.info.robot_type != b.info.robot_type:
        yield f"{root} has the robot {b.info.robot_type}, not {a.info.robot_type}"
    for name in a.info.features:
        if name not in b.info.features:
            yield f"{root} has no {name}"
    for name, feature in b.info.features.items():
        there = a.info.features.get(name)
        if there is None:
            yield f"{root} has {name}, which the first one lacks"
            continue
        for what, value, first in feature.differences(there):
            yield f"{name} of {root} has {what} {value}, not {first}"
