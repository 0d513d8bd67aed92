"""The errors that demorec raises on purpose: one tree, each one sentence to the user.

A dropped cube is not an error but an `Outcome`; an error means that no trustworthy result could be made.
All arguments go to `super().__init__`, so that errors cross process borders (pickle) unchanged.
"""

from __future__ import annotations

import errno
import json
import os
import struct
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from pathlib import Path


class DemorecError(Exception):
    """Base of the tree; `exit_code` is what the command line returns for it."""

    exit_code = 1


class ConfigError(DemorecError):
    """What the user asked for cannot be: an unknown name, an impossible number, an unusable folder."""

    exit_code = 2


class OptionError(ConfigError):
    """The value of one option is impossible. Reported with the name of the field, as Python and TOML files have it.

    Args:
        option: Name of the field ("max_attempts").
        problem: The rest of the sentence ("is 0, allowed are 1 to 100.").
    """

    def __init__(self, option: str, problem: str) -> None:
        super().__init__(option, problem)

    def __str__(self) -> str:
        return " ".join(self.args)

    def of_flag(self) -> str:
        """The sentence with the name of the flag, for the command line ("--max-attempts is 0, ...")."""
        option, problem = self.args
        return f"--{option.replace('_', '-')} {problem}"


def check_option(option: str, value: float | None, low: float, high: float, unit: str = "") -> None:
    """Raise OptionError unless low <= value <= high; None, which leaves the choice to demorec, is always allowed."""
    if value is not None and not low <= value <= high:
        least, most = (f"{limit:,}" if isinstance(limit, int) else f"{limit:g}" for limit in (low, high))
        raise OptionError(option, f"is {value}, allowed are {least} to {most}{unit and ' '}{unit}.")


def check_seed(option: str, value: int | None) -> None:
    """Raise OptionError unless a seed fits in 63 bits; None, which leaves the choice to demorec, is always allowed."""
    check_option(option, value, 0, 2**63 - 1)


class NotAllowedError(ConfigError):
    """A file names a module from outside of demorec, and the user has not said that it may be run."""


class SceneError(DemorecError):
    """No scene could be laid out or simulated within the given ranges; tried again a bounded number of times."""


class RenderError(DemorecError):
    """An image cannot be drawn: a shape that no renderer knows, a broken mesh, a missing OpenGL library."""


class RecordingError(DemorecError):
    """A recording cannot be written or read: no MCAP, cut off, damaged, of an unknown format version."""


class NotGeneratedError(RecordingError):
    """A recording was rendered or replayed from another one, or a policy made it."""


class ExportError(DemorecError):
    """A dataset cannot be written: recordings that differ, a target in the way, a failed verification."""


class GenerationError(DemorecError):
    """A run cannot go on: a full disk, a vanished folder, workers that die; what is finished stays."""


class ResourceError(DemorecError):
    """The machine lacks memory or open files, or cannot read its disk: says nothing about the data that it was to read.

    Never a reason to call a file damaged, to set it aside or to make it again.
    """


_LACKS = {
    errno.ENOMEM: "This machine has too little memory for this: free some, or raise the limit (ulimit -v)",
    errno.EMFILE: "Too few files may be open for this: raise the limit (ulimit -n)",
    errno.ENFILE: "Too many files are open on this machine: end other programs",
    errno.EIO: "The storage reports an input/output error: see whether it is sound",
}

_LINKER_WORDS = {"failed to map segment": errno.ENOMEM}
_LINKER_WORDS |= {os.strerror(number): number for number in (errno.ENOMEM, errno.EMFILE, errno.ENFILE)}


def resource_error(error: BaseException, path: Path | None = None) -> ResourceError | None:
    """What `error`, or one that it was raised from, says about the machine; None when it is about something else.

    Args:
        error: Caught while something was read or written.
        path: Of that, if it is known.
    """
    for cause in error_chain(error):
        if isinstance(cause, ResourceError):
            return cause
        if isinstance(cause, BrokenExecutor):
            return ResourceError(
                "A process of this command was killed, perhaps for lack of memory: try again with fewer --workers."
            )
        number = errno.ENOMEM if isinstance(cause, MemoryError) else getattr(cause, "errno", None)
        if isinstance(cause, ImportError | OSError) and number is None:  # the dynamic linker says why in words alone
            number = next((number for words, number in _LINKER_WORDS.items() if words in str(cause)), None)
        if number in _LACKS:
            unknown = "." if path is None else f"; whether the file is sound is not known: {path}"
            return ResourceError(_LACKS[number] + unknown)
    return None


_UNUSABLE = frozenset(
    {
        errno.EACCES,
        errno.EEXIST,
        errno.EISDIR,
        errno.ELOOP,
        errno.ENAMETOOLONG,
        errno.ENOENT,
        errno.ENOTDIR,
        errno.EPERM,
        errno.EROFS,
    }
)
"""Errors of a target that the user has to choose again; others are about the machine, such as a full disk."""


def write_error(
    what: str, error: OSError, target: Path, otherwise: type[DemorecError], *, reason: str = ""
) -> DemorecError:
    """Return the error to be raised for a target that cannot be written: ConfigError where another one must be chosen.

    Args:
        what: Subject of the sentence ("The dataset").
        error: Raised while the target was written.
        target: The path that the user named.
        otherwise: Type for all other reasons.
        reason: Why, in words; "" for those of the operating system.
    """
    kind = ConfigError if error.errno in _UNUSABLE else otherwise
    return kind(f"{what} cannot be written ({reason or error.strerror or error}): {target}")


_MAX_WORDS = 300
"""Characters: an error may quote what a file holds."""
_PLAIN_WORDS: tuple[tuple[type[BaseException], str], ...] = (
    (UnicodeDecodeError, "it is no UTF-8 text"),
    (RecursionError, "its values are nested too deeply"),
    (struct.error, "it ends within a value"),
    (EOFError, "it ends too early"),
    (IndexError, "it has fewer values than it should"),
    (TypeError, "a value is of another kind than expected"),
    (AttributeError, "a value is of another kind than expected"),
    (ArithmeticError, "a number is out of range"),
)
"""What errors of Python mean about a file that is read; their own words are about the program that reads it."""


def describe_error(error: BaseException) -> str:
    """What an error of Python or of a library says about what was read, for the inside of a sentence.

    Neither class names nor error numbers, and no path: the sentence around it has that.
    """
    if isinstance(error, DemorecError):
        return str(error)
    reason = getattr(error, "strerror", None)  # of the system's errors and of FFmpeg's
    if isinstance(reason, str) and reason:
        return reason
    if isinstance(error, json.JSONDecodeError):
        return f"it is no JSON, line {error.lineno}"
    if isinstance(error, KeyError) and error.args:
        return f"it has no {error.args[0]!r}"[:_MAX_WORDS]
    for kind, words in _PLAIN_WORDS:
        if isinstance(error, kind):
            return words
    lines = str(error).split("\n", 1)
    if "set_int_max_str_digits" in lines[0]:
        return "a whole number has more digits than are read"
    return lines[0].rstrip(".")[:_MAX_WORDS] or "no reason is given"


def without_path(error: BaseException, path: Path) -> str:
    """What an error of ours says, without the path at its end, for a sentence that names the path already."""
    return str(error).removesuffix(f": {path}")


def as_reason(error: BaseException) -> str:
    """The message of an error as the rest of a sentence, behind "since"."""
    text = describe_error(error)
    return text[:1].lower() + text[1:].rstrip(".")


def error_chain(error: BaseException) -> Iterator[BaseException]:
    """An error, what it was raised from, and so on."""
    cause: BaseException | None = error
    seen: list[BaseException] = []
    while cause is not None and cause not in seen:
        yield cause
        seen.append(cause)
        cause = cause.__cause__ or cause.__context__


class MissingDependencyError(DemorecError):
    """An optional package is not installed.

    Args:
        feature: What the user asked for, as the start of a sentence ("The Ray executor").
        package: The package that is missing.
        remedy: What to type to mend it.
    """

    def __init__(self, feature: str, package: str, remedy: str) -> None:
        super().__init__(feature, package, remedy)

    def __str__(self) -> str:
        feature, package, remedy = self.args
        return f"{feature} needs the package {package!r}, which is not installed: {remedy}."
