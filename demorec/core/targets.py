"""Type of options that name a new file or folder, and the check for impossible names."""

from __future__ import annotations

import dataclasses
import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

from demorec.core.errors import OptionError

_TARGET = object()
"""Marker of the type."""
Target = Annotated[Path, _TARGET]
OptionalTarget = Annotated[Path | None, _TARGET]


def check_targets(command: Any) -> None:
    """Check the targets of a command before it does anything.

    Args:
        command: A dataclass whose fields, and those of nested dataclasses, are options.

    Raises:
        OptionError: A target can never be created: its name is too long or not UTF-8, it is below a file, or it is (or
        is below) a dangling link.
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
                raise OptionError(option, f"{what} a link whose target is missing, remove it: {target}")


def is_utf8(path: Path) -> bool:
    """Whether a path is UTF-8 text; PyArrow and Rerun, for example, open no other paths."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def _targets(command: Any) -> Iterator[tuple[str, Path]]:
    """Yield (option, path) of each target that the user has named."""
    hints = get_type_hints(type(command), include_extras=True)
    for field in dataclasses.fields(command):
        value = getattr(command, field.name)
        if dataclasses.is_dataclass(value):
            yield from _targets(value)
        elif value is not None and _TARGET in get_args(hints[field.name]):
            yield field.name, value
