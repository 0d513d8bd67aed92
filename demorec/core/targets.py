"""Options that name a new file or folder: one type, and one rule for names that none can have."""

from __future__ import annotations

import dataclasses
import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

from demorec.core.errors import OptionError

_TARGET = object()
"""Marks the type of a target."""
Target = Annotated[Path, _TARGET]
OptionalTarget = Annotated[Path | None, _TARGET]


def check_targets(command: Any) -> None:
    """Check the targets of a command before it does anything.

    Args:
        command: A dataclass whose fields, and those of dataclasses in it, are options.

    Raises:
        OptionError: A target can never be made: its name is too long or not UTF-8, it is below a file, it is, or is
            below, a link to something that is not there.
    """
    for option, target in _targets(command):
        if not is_utf8(target):
            raise OptionError(option, f"has bytes that are not UTF-8, choose another name: {target}")
        try:
            target.lstat()
        except OSError as error:
            if error.errno != errno.ENOENT:
                raise OptionError(option, f"cannot be written ({error.strerror}), choose another: {target}") from error
        for place in (target, *target.parents):
            if place.is_symlink() and not place.exists():
                what = "is" if place == target else f"is below {place.name},"
                raise OptionError(option, f"{what} a link to something that is not there, remove it: {target}")


def is_utf8(path: Path) -> bool:
    """Whether a path is text; PyArrow and Rerun, for example, open no other ones."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def _targets(command: Any) -> Iterator[tuple[str, Path]]:
    """(option, path) of the targets that the user has named."""
    hints = get_type_hints(type(command), include_extras=True)
    for field in dataclasses.fields(command):
        value = getattr(command, field.name)
        if dataclasses.is_dataclass(value):
            yield from _targets(value)
        elif value is not None and _TARGET in get_args(hints[field.name]):
            yield field.name, value
