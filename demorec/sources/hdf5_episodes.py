"""Where the episodes of an HDF5 file are, and what its attributes say of them: task, rate, outcome, model."""

from __future__ import annotations

import json
import math
import reprlib
import sys
from functools import lru_cache
from typing import Any

import numpy as np

from demorec.core.registry import nearest_match
from demorec.datasets.hdf5.foreign import ForeignFile, Hdf5Error, Scalar
from demorec.sources.hdf5_mapping import Hdf5Episodes, Hdf5Mapping
from demorec.sources.mapping_file import MAX_FPS
from demorec.sources.words import in_natural_order, task_in_name

_RATES = ("fps", "env_args.env_kwargs.fps", "env_args.env_kwargs.control_freq")
"""Attributes that say how many rows a second has: our own, and robosuite's."""


def episode_places(file: ForeignFile, episodes: Hdf5Episodes) -> list[str]:
    """The groups of the episodes, demo_2 before demo_10.

    Raises:
        Hdf5Error: There are none, not those of the mask, or one of them twice.
    """
    group = episodes.group.strip("/")
    if not group:
        return [""]
    kinds = file.children(group)
    names = [name for name, kind in kinds.items() if kind != "dataset"]
    if episodes.mask:
        wanted = set(file.names(f"mask/{episodes.mask}"))
        if missing := sorted(wanted - set(names)):
            raise Hdf5Error(f"mask/{episodes.mask} lists {missing[0]!r}, which is not in {group}: {file.path}")
        names = [name for name in names if name in wanted]
    if not names:
        raise Hdf5Error(f"There are no episodes in {group}: {file.path}")
    if others := [name for name in names if kinds[name] == "other"]:
        raise Hdf5Error(
            f"{group}/{others[0]} is a link or a type, only groups within the file are episodes: {file.path}"
        )
    places = [f"{group}/{name}" for name in sorted(names, key=in_natural_order)]
    seen: dict[int, str] = {}
    for place in places:
        first = seen.setdefault(file.address(place), place)
        if first != place:
            raise Hdf5Error(f"{place} is the same group as {first}, an episode stands in a file once: {file.path}")
    return places


def found_attribute(file: ForeignFile, place: str, name: str) -> Scalar | None:
    """An attribute of an episode, or of a group above it; a name with dots goes on into the JSON of one."""
    groups = place.split("/")
    for level in ("/".join(groups[:depth]) for depth in range(len(groups), -1, -1)):
        if (found := file.attribute(level, name)) is not None:
            return found
        first, _, keys = name.partition(".")
        text = file.attribute(level, first) if keys else None
        if isinstance(text, str) and (inside := _in_json(text, keys.split("."))) is not None:
            return inside
    return None


def _in_json(text: str, keys: list[str]) -> Scalar | None:
    value = _parsed(text)
    for key in keys:
        if isinstance(value, list):
            value = value[int(key)] if key.isdecimal() and len(key) < 10 and int(key) < len(value) else None
        else:
            value = value.get(key) if isinstance(value, dict) else None
    return value if isinstance(value, str | bool | int | float) else None


@lru_cache(maxsize=4)
def _parsed(text: str) -> Any:
    """Of JSON, which may stand above a thousand episodes; None when it is none."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def rate_of(file: ForeignFile, place: str, mapping: Hdf5Mapping) -> int:
    """Rows a second; Hdf5Error when neither the mapping nor the file says it, or no whole number."""
    if mapping.clock.fps is not None:
        return mapping.clock.fps
    found = told_rate(file, place)
    if found is None:
        raise Hdf5Error(
            f"Nothing in the file says how many rows a second has: give clock.fps in the mapping: {file.path}"
        )
    if not 1 <= found <= MAX_FPS or found != int(found):
        raise Hdf5Error(
            f"The file says that it has {found:g} rows a second, allowed are whole numbers from 1 to {MAX_FPS}: give "
            f"clock.fps in the mapping: {file.path}"
        )
    return int(found)


def told_rate(file: ForeignFile, place: str) -> float | None:
    """What the file's attributes say of the rate; None when they say nothing."""
    for name in _RATES:
        found = found_attribute(file, place, name)
        if isinstance(found, int | float) and not isinstance(found, bool):
            return float(found) if abs(found) <= sys.float_info.max else math.inf
    return None


def task_of(file: ForeignFile, place: str, mapping: Hdf5Mapping) -> str:
    """What the robot was asked to do; Hdf5Error when the file does not say."""
    task = mapping.task
    if task.text:
        return " ".join(task.text.split())
    if task.file_name:
        if text := task_in_name(file.path.stem):
            return text
        raise Hdf5Error(f"The file's name says no task, which the mapping takes from it: {file.path}")
    found = found_attribute(file, place, task.attribute)
    if not isinstance(found, str) or not found.strip():
        raise Hdf5Error(f"No attribute {task.attribute!r} says the task of {place or 'the episode'}: {file.path}")
    return " ".join(found.split())


def success_of(file: ForeignFile, place: str, mapping: Hdf5Mapping, num_rows: int) -> bool | None:
    """How an episode ended; None where the mapping does not ask, or other episodes of the file alone say it.

    Raises:
        Hdf5Error: No episode says it, or this one says something else.
    """
    name = mapping.episodes.success.strip("/")
    if not name:
        return None
    found = file.attribute(place, name)
    if isinstance(found, str) or (isinstance(found, float) and not math.isfinite(found)):
        raise Hdf5Error(
            f"{place or 'The episode'} says {name} = {reprlib.repr(found)}, allowed are booleans and numbers: "
            f"{file.path}"
        )
    if found is not None:
        return bool(found)
    if not file.has(f"{place}/{name}"):
        if any(file.attribute(other, name) is not None for other in episode_places(file, mapping.episodes)):
            return None
        near = nearest_match(name, list(file.children(place)))
        raise Hdf5Error(
            f"{place or 'The episode'} has no attribute or dataset {name!r} that says how it ended.{near}".rstrip(".?")
            + f": {file.path}"
        )
    array = file.array(f"{place}/{name}".lstrip("/"))
    if len(array) != num_rows:
        raise Hdf5Error(f"{array.place} has {len(array)} rows, the episode has {num_rows}: {file.path}")
    return bool((array.read(num_rows - 1, num_rows).astype(np.float64) > 0).all())
