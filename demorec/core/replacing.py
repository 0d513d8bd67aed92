"""The rule of all commands for replacing and deleting files.

A command replaces only a file or folder that it recognises, by its content, as the kind that it makes, and only if the
user asks for it. It never replaces one of its sources, a folder that a person lives or works in, or a folder with
foreign content. The old content stays complete until the new one is complete (`demorec.core.atomic`), except that of a
run or an evaluation, which is deleted before the new one begins.
"""

from __future__ import annotations

import dataclasses
import errno
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

from demorec.core.errors import ConfigError, DemorecError, OptionError, resource_error, write_error
from demorec.core.files import MCAP_MAGIC, RERUN_MAGICS, read_json_limited

_SHOWN = 5
"""Maximum foreign files in an error message."""


@dataclass(frozen=True, kw_only=True)
class ReplaceableKind:
    """A kind of file or folder that a command makes and may replace.

    Attributes:
        name: Noun for a sentence: "a recording".
        is_folder: Whether it is a folder.
        recognises: Whether a file or folder is of this kind, judged by its content.
        strangers: Names, relative to the folder or within the file, of content that is not part of this kind and would
        be deleted.
        advice: Action for the user if one already exists.
    """

    name: str
    recognises: Callable[[Path], bool]
    is_folder: bool = False
    strangers: Callable[[Path], Sequence[str]] = lambda path: ()
    advice: str = "choose another name, or --overwrite to replace it"


def _begins_with(*magics: bytes) -> Callable[[Path], bool]:
    def recognises(path: Path) -> bool:
        with path.open("rb") as file:
            return file.read(max(map(len, magics))).startswith(magics)

    return recognises


RECORDING = ReplaceableKind(name="a recording (MCAP)", recognises=_begins_with(MCAP_MAGIC))
RERUN_FILE = ReplaceableKind(name="a Rerun file (.rrd)", recognises=_begins_with(*RERUN_MAGICS))
REPORT_MARK = "<!doctype html>\n<!-- A report by demorec. -->\n"
REPORT = ReplaceableKind(name="a report (HTML)", recognises=_begins_with(REPORT_MARK.encode()))


def check_replaceable(target: Path, kind: ReplaceableKind, *, overwrite: bool, sources: Iterable[Path] = ()) -> None:
    """Raise unless `target` is free, or is of this kind and the user asks for replacement.

    An empty folder counts as free; an empty file does not, because it may be a lock or a marker. The `sources` of the
    command, the folders that contain them and their content are never replaced.

    Raises:
        ConfigError: The target exists and the user does not ask for replacement, or it must never be replaced.
    """
    reason = obstacle(target, kind, sources)
    if not reason and (not os.path.lexists(target) or _is_empty(target)):
        return
    if not overwrite:
        if reason:
            raise ConfigError(f"The target exists already and must not be replaced, since {reason}: {target}")
        raise ConfigError(f"{kind.name[0].upper()}{kind.name[1:]} exists already: {kind.advice}: {target}")
    if reason:
        raise ConfigError(f"This is never replaced, since {reason}: choose another name: {target}")


def obstacle(target: Path, kind: ReplaceableKind, sources: Iterable[Path] = ()) -> str:
    """Reason why `target` must not be replaced, for `check_replaceable`; "" if it may be, or is missing."""
    try:
        if not os.path.lexists(target):
            return ""
        if not target.exists():
            return "it is a link whose target is missing"
        if reason := use_as_source(target.resolve(), sources):
            return reason
        if kind.is_folder and not target.is_dir():
            return f"it is a file, not {kind.name}"
        if not kind.is_folder and not target.is_file():
            return f"it is {'a folder' if target.is_dir() else 'no regular file'}, not {kind.name}"
        reason = protection(target) if kind.is_folder else ""
        if reason or _is_empty(target):
            return reason
        if not kind.recognises(target):
            return f"it is not {kind.name}"
        foreign = kind.strangers(target)
        return f"it holds files that are not part of {kind.name} ({shown(foreign)})" if foreign else ""
    except OSError as error:
        return f"it cannot be read ({error.strerror})"


def use_as_source(target: Path, sources: Iterable[Path]) -> str:
    """How a command with these sources uses `target`, a resolved path; "" if it does not."""
    for source in sources:
        resolved = source.resolve()
        if resolved == target:
            return "it is an input of this command"
        if resolved.is_relative_to(target):
            return f"an input of this command is inside it ({source})"
        if target.is_relative_to(resolved):
            return f"it is inside an input of this command ({source})"
    return ""


def protection(folder: Path) -> str:
    """Reason why a folder is never replaced, because a person lives or works there; "" for other folders."""
    resolved = folder.resolve()
    if resolved == resolved.parent:
        return "it is the root of the file system"
    for what, place in (("home folder", Path.home()), ("current folder", Path.cwd())):
        if place.resolve() == resolved:
            return f"it is the {what}"
        if place.resolve().is_relative_to(resolved):
            return f"the {what} is inside it"
    return "it is a repository (.git)" if os.path.lexists(resolved / ".git") else ""


def _is_empty(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def shown(names: Sequence[object], most: int = _SHOWN) -> str:
    """The first few names, for a sentence."""
    return ", ".join(map(str, names[:most])) + (", ..." if len(names) > most else "")


def files_below(folder: Path) -> Iterator[str]:
    """Entries of a folder, except folders but including links to folders, relative to it and in order."""
    for place, folders, files in os.walk(folder):
        links = [name for name in folders if (Path(place) / name).is_symlink()]
        folders.sort()
        for name in sorted((*files, *links)):
            yield (Path(place) / name).relative_to(folder).as_posix()


def json_object(path: Path) -> dict[str, Any]:
    """Read the JSON object in a regular file; {} if it is missing or larger than any of demorec's."""
    try:
        found = read_json_limited(path)
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def delete_parts(folder: Path, names: Sequence[str]) -> None:
    """Delete parts of a folder, existing or not, in this order; DemorecError if one cannot be deleted."""
    try:
        for part in (folder / name for name in names):
            if part.is_dir() and not part.is_symlink():
                shutil.rmtree(part)
            else:
                part.unlink(missing_ok=True)
    except OSError as error:
        raise resource_error(error) or write_error("The folder", error, folder, DemorecError) from error


_TARGET = object()
"""Marker of the type."""
Target = Annotated[Path, _TARGET]
OptionalTarget = Annotated[Path | None, _TARGET]


def check_targets(command: Any) -> None:
    """Check the targets among the options of a command, a dataclass, before it does anything.

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
