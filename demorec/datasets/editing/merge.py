"""Several datasets into one: features matched by name, all differences named at once, a mapping (TOML) to solve them.

[[dataset]]
path = "b"                                  # as on the command line
robot_type = "so100"                        # what its arm is called in the merged dataset
drop = ["observation.images.side"]

[dataset.feature."observation.state"]       # a feature of the merged dataset
from = "state"                              # its name in this one; "" for one that is filled
elements = ["shoulder", "gripper"]          # names here, in the order of the first dataset; "" is filled
fill = 0.0
unit = "degree"                             # here: rad (as it is), degree, or normalised, with low and high in rad
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.errors import ConfigError, describe_error
from demorec.core.files import read_text_limited
from demorec.core.registry import check_choice, nearest_match
from demorec.datasets.editing.operations import joined
from demorec.datasets.editing.plan import Plan, Source, Take
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetFeature

_UNITS = ("rad", "degree", "normalised")
_MAX_BYTES = 1 << 20
_KEYS = ("path", "robot_type", "drop", "feature")
_FEATURE_KEYS = ("from", "elements", "fill", "unit", "low", "high")


class DatasetsDifferError(ConfigError):
    """Datasets that cannot be joined as they are.

    Args:
        sentence: All differences.
        mapping: Lines of a mapping under which those of one rate fit, as far as any does.
    """

    def __init__(self, sentence: str, mapping: Sequence[str]) -> None:
        super().__init__(sentence, mapping)
        self.mapping = mapping

    def __str__(self) -> str:
        return str(self.args[0])


def merge(sources: Sequence[Source], mapping: Path | None = None) -> Plan:
    """All episodes of all datasets, one after the other.

    Raises:
        DatasetsDifferError: They differ; with all differences, and a mapping that would solve what one can.
        ConfigError: The mapping cannot be used.
    """
    if len(sources) < 2:
        raise ConfigError("Name two or more datasets to merge.")
    entries = {} if mapping is None else _read(mapping, [source.root for source in sources])
    plans: list[Plan] = []
    for source in sources:
        entry = entries.get(source.root.resolve(), {})
        plans.append(_mapped(Plan.whole(source), entry, plans[0] if plans else None, mapping))
    wrong = [text for plan in plans[1:] for text in _differences(plans[0], plan)]
    if wrong:
        raise DatasetsDifferError(f"These datasets differ: {'; '.join(wrong)}.", list(_suggested(plans)))
    takes = [{name: plan.takes[0][name] for name in plans[0].takes[0]} for plan in plans]
    return joined([replace(plan, takes=(take,)) for plan, take in zip(plans, takes, strict=True)])


def _read(path: Path, roots: Sequence[Path]) -> dict[Path, dict[str, Any]]:
    try:
        data = tomllib.loads(read_text_limited(path, _MAX_BYTES))
        found = data.get("dataset", [])
        entries = {Path(entry["path"]).resolve(): dict(entry) for entry in found}
        if set(data) - {"dataset"}:
            raise ValueError(f"it has {sorted(set(data) - {'dataset'})[0]!r} beside the datasets")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ConfigError(f"The mapping cannot be used ({describe_error(error)}): {path}") from error
    if strange := [entry for entry in entries if entry not in [root.resolve() for root in roots]]:
        raise ConfigError(f"The mapping is about a dataset that is not merged, {strange[0]}: {path}")
    return entries


def _mapped(plan: Plan, entry: Mapping[str, Any], first: Plan | None, path: Path | None) -> Plan:
    """A dataset as its entry in the mapping wants it."""
    for key in entry:
        check_choice("key of a mapping", key, _KEYS)
    features, takes = dict(plan.info.features), dict(plan.takes[0])
    for name in entry.get("drop", ()):
        if name not in takes:
            raise ConfigError(f"The mapping drops {name!r}, which is not there.{nearest_match(name, takes)}: {path}")
        del features[name], takes[name]
    wanted = entry.get("feature", {})
    used = {item.get("from", name) for name, item in wanted.items()}
    for name in used - set(wanted):  # renamed
        features.pop(name, None)
        takes.pop(name, None)
    for name, item in wanted.items():
        for key in item:
            check_choice("key of a feature in a mapping", key, _FEATURE_KEYS)
        model = first.info.features.get(name) if first is not None else None
        try:
            features[name], takes[name] = _converted(plan.info.features, name, item, model)
        except (ValueError, TypeError, KeyError) as error:
            raise ConfigError(f"The mapping of {name} cannot be used ({describe_error(error)}): {path}") from error
    fixed = {name: features.pop(name) for name in AUTOMATIC_FEATURES}
    mapped = plan.with_features({**features, **fixed}, [takes])
    return replace(mapped, info=replace(mapped.info, robot_type=entry.get("robot_type", mapped.info.robot_type)))


def _converted(
    there: Mapping[str, DatasetFeature], name: str, item: Mapping[str, Any], model: DatasetFeature | None
) -> tuple[DatasetFeature, Take]:
    origin = item.get("from", name)
    plain = set(item) <= {"from"}
    if origin and origin not in there:
        raise ValueError(f"there is no feature {origin!r}")
    if plain and origin:
        return there[origin], Take(feature=origin)
    target = model if model is not None else there[origin]
    width = target.shape[0]
    if not _is_vector(target, *([there[origin]] if origin else ())):
        raise ValueError("only vectors of numbers are converted")
    elements: tuple[int, ...] | None = None if origin else (-1,) * width
    if "elements" in item:
        names = list(there[origin].names or map(str, range(there[origin].shape[0])))
        elements = tuple(names.index(text) if text else -1 for text in item["elements"])
        if model is None:
            target = replace(target, shape=(len(elements),), names=tuple(item["elements"]))
            width = len(elements)
    if (len(elements) if elements is not None else there[origin].shape[0]) != width:
        raise ValueError(f"it gives another number of elements than {width}")
    if elements is not None and -1 in elements and "fill" not in item:
        raise ValueError("fill is missing, which says what elements have that come from nowhere")
    scale, offset = _unit(item, width)
    fill = np.broadcast_to(np.asarray(item.get("fill", 0.0), dtype=np.float64), (width,))
    return target, Take(feature=origin, elements=elements, scale=scale, offset=offset, fill=fill)


def _unit(item: Mapping[str, Any], width: int) -> tuple[Any, Any]:
    """(D,) factor and summand that make rad of numbers in a unit."""
    unit = check_choice("unit", str(item.get("unit", "rad")), _UNITS)
    if unit == "rad":
        return None, None
    if unit == "degree":
        return np.full(width, math.pi / 180), None
    low, high = (np.broadcast_to(np.asarray(item[key], dtype=np.float64), (width,)) for key in ("low", "high"))
    return (high - low) / 200, (high + low) / 2  # LeRobot's range of a joint is -100 to 100


def _differences(a: Plan, b: Plan) -> Iterator[str]:
    root = b.sources[0].root
    if a.info.fps != b.info.fps:
        yield f"{root} has {b.info.fps} frames a second, not {a.info.fps}, which no mapping solves"
    if a.info.robot_type != b.info.robot_type:
        yield f"{root} has the robot {b.info.robot_type}, not {a.info.robot_type}"
    for name in a.info.features:
        if name not in b.info.features:
            yield f"{root} has no {name}"
    for name, feature in b.info.features.items():
        there = a.info.features.get(name)
        if there is None:
            yield f"{root} has {name}, which the first one has not"
            continue
        for what, value, first in feature.differences(there):
            yield f"{name} of {root} has {what} {value}, not {first}"


def _suggested(plans: Sequence[Plan]) -> Iterator[str]:
    plans = [plan for plan in plans if plan.info.fps == plans[0].info.fps]
    if len(plans) < 2:
        return
    robots = [plan.info.robot_type for plan in plans if plan.info.robot_type]
    numeric = [{n: f for n, f in plan.info.features.items() if _is_vector(f)} for plan in plans]
    common = {
        name
        for name, feature in plans[0].info.features.items()
        if all(
            name in plan.info.features
            and (_is_vector(feature, plan.info.features[name]) or _fits(feature, plan.info.features[name]))
            and (feature.dtype == plan.info.features[name].dtype)
            for plan in plans
        )
    }
    for number, plan in enumerate(plans):
        yield from ("[[dataset]]", f"path = {_quoted(str(plan.sources[0].root))}")
        if robots and plan.info.robot_type != robots[0]:
            yield f"robot_type = {_quoted(robots[0])}"
        if dropped := [name for name in plan.info.features if name not in common]:
            yield f"drop = {_quoted(dropped)}"
        yield from _other_names(plans[0], plan)
        for name in [name for name in numeric[number] if name in common] if number else ():
            mine, first = plan.info.features[name], plans[0].info.features[name]
            if (mine.shape, mine.names) != (first.shape, first.names):
                own = mine.names or tuple(map(str, range(mine.shape[0])))
                wanted = first.names or tuple(map(str, range(first.shape[0])))
                elements = [text if text in own else "" for text in wanted]
                yield from (f"[dataset.feature.{_quoted(name)}]", f"elements = {_quoted(elements)}")
                yield from ["fill = 0.0"] if "" in elements else []
        yield ""


def _other_names(first: Plan, plan: Plan) -> Iterator[str]:
    """Comments: which features may be one under two names, which nobody but the user knows."""
    there, here = first.info.features, plan.info.features
    for name in [name for name in there if name not in here]:
        for own in [own for own in here if own not in there and _fits(here[own], there[name])]:
            yield f"# If {_quoted(own)} is what the first one calls {_quoted(name)}, drop neither, and add:"
            yield from (f"# [dataset.feature.{_quoted(name)}]", f"# from = {_quoted(own)}")


def _quoted(value: object) -> str:
    """As TOML has it, which knows no surrogates."""
    return json.dumps(value, ensure_ascii=False)


def _is_vector(*features: DatasetFeature) -> bool:
    return all(feature.is_numeric and len(feature.shape) == 1 for feature in features)


def _fits(a: DatasetFeature, b: DatasetFeature) -> bool:
    return not any(a.differences(b))
