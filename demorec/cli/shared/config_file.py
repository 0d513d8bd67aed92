"""Values of a TOML file as the defaults of a command's flags: a file's keys are the flags' names, a flag wins."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

from demorec.config import read_toml
from demorec.errors import ConfigError
from demorec.plain import from_plain, to_plain
from demorec.registry import nearest_match


def config_path(args: Sequence[str]) -> Path | None:
    """What --config names on a command line that has not been parsed yet."""
    for position, arg in enumerate(args):
        if arg == "--config" and position + 1 < len(args):
            return Path(args[position + 1])
        if arg.startswith("--config="):
            return Path(arg.partition("=")[2])
    return None


def with_file_values[T](command: T, path: Path) -> T:
    """A copy of `command` with the values of a TOML file; its keys are fields of `command` or of dataclasses in it.

    Raises:
        ConfigError: The file cannot be read, or has unknown keys or values of a wrong type; all of them at once.
    """
    values = {key.replace("-", "_"): value for key, value in read_toml(path).items()}
    places = dict(_places(command))
    wrong = [f"an unknown key {key!r}.{nearest_match(key, places)}" for key in values if key not in places]
    if wrong:
        raise ConfigError(f"The config file has {' '.join(wrong)} Its keys are the flags' names: {path}")
    for key, value in values.items():
        owner_path = places[key]
        try:
            command = cast(T, _replaced(command, owner_path, key, value))
        except ValueError as error:
            wrong.append(f"{key}: {str(error).partition(' @ ')[0]}")
    if wrong:
        raise ConfigError(f"The config file has wrong values ({'; '.join(wrong)}): {path}")
    return command


def _places(owner: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Name of each flag -> the fields that lead to the dataclass that has it."""
    for field in dataclasses.fields(owner):
        value = getattr(owner, field.name)
        if dataclasses.is_dataclass(value):
            yield from _places(value, (*above, field.name))
        elif field.name != "config":
            yield field.name, above


def _replaced(owner: Any, above: tuple[str, ...], key: str, value: Any) -> Any:
    if above:
        return dataclasses.replace(owner, **{above[0]: _replaced(getattr(owner, above[0]), above[1:], key, value)})
    if isinstance(getattr(owner, key), tuple) and not isinstance(value, list):
        value = [value]  # cameras = "front" says what it means
    return dataclasses.replace(owner, **{key: getattr(from_plain({**to_plain(owner), key: value}, type(owner)), key)})
