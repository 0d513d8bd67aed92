"""Errors that demorec raises on purpose: one tree; each message is one sentence for the user.

A dropped cube is not an error but an `Outcome`; an error means that there is no trustworthy result. All arguments are
passed to `super().__init__`, so that errors survive pickling between processes.
"""

from __future__ import annotations

import errno
import json
import os
import re
import struct
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from pathlib import Path


class DemorecError(Exception):
    """Base of the tree; `exit_code` is what the command line returns for it."""

    exit_code = 1


class ConfigError(DemorecError):
    """Impossible request: an unknown name, an impossible number, an unusable folder."""

    exit_code = 2


class OptionError(ConfigError):
    """Impossible value of one option: its field ("max_attempts") and the problem ("is 0, allowed are 1 to 100.")."""

    def __init__(self, option: str, problem: str) -> None:
        super().__init__(option, problem)

    def __str__(self) -> str:
        return " ".join(self.args)

    def of_flag(self) -> str:
        """The sentence with the flag's name, for the command line ("--max-attempts is 0, ...")."""
        option, problem = self.args
        return f"--{option.replace('_', '-')} {problem}"


def check_option(option: str, value: float | None, low: float, high: float, unit: str = "") -> None:
    """Raise OptionError unless low <= value <= high; None is always allowed and leaves the choice to demorec."""
    if value is not None and not low <= value <= high:
        least, most = (f"{limit:,}" if isinstance(limit, int) else f"{limit:g}" for limit in (low, high))
        raise OptionError(option, f"is {value}, allowed are {least} to {most}{unit and ' '}{unit}.")


def check_seed(option: str, value: int | None) -> None:
    """Raise OptionError unless a seed fits in 63 bits; None is always allowed and leaves the choice to demorec."""
    check_option(option, value, 0, 2**63 - 1)


class NotAllowedError(ConfigError):
    """A file names a third-party module that the user has not allowed to run."""


class SceneError(DemorecError):
    """No scene could be laid out or simulated within the given ranges, after a limited number of attempts."""


class RenderError(DemorecError):
    """An image cannot be rendered: an unsupported shape, a broken mesh, a missing OpenGL library."""


class RecordingError(DemorecError):
    """A recording cannot be written or read: not an MCAP file, truncated, damaged, of an unknown format version."""


class NotGeneratedError(RecordingError):
    """A recording is a render, a replay or a policy rollout."""


class ExportError(DemorecError):
    """A dataset cannot be written: recordings that differ, an existing target, a failed verification."""


class GenerationError(DemorecError):
    """A run cannot continue: a full disk, a vanished folder, dying workers; finished episodes stay."""


class ResourceError(DemorecError):
    """The machine lacks memory or file descriptors, or cannot read its disk; this implies nothing about the data.

    Never a reason to call a file damaged, to set it aside or to record it again.
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
    """Return the machine's failure behind `error` or one of its causes; None if the machine is not the cause."""
    for cause in error_chain(error):
        if isinstance(cause, ResourceError):
            return cause
        if isinstance(cause, BrokenExecutor):
            return ResourceError(
                "A process of this command was killed, perhaps for lack of memory: try again with fewer --workers."
            )
        number = errno.ENOMEM if isinstance(cause, MemoryError) else getattr(cause, "errno", None)
        # the dynamic linker gives the reason only as text
        if isinstance(cause, ImportError | OSError) and number is None:
            number = next((number for words, number in _LINKER_WORDS.items() if words in str(cause)), None)
        if number in _LACKS:
            unknown = "." if path is None else f"; whether the file is sound is not known: {path}"
            return ResourceError(_LACKS[number] + unknown)
    return None


_UNUSABLE = {errno.EACCES, errno.EEXIST, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.ENOENT, errno.ENOTDIR}
_UNUSABLE |= {errno.EINVAL, errno.EPERM, errno.EROFS}
"""Errors that another target fixes; others concern the machine, such as a full disk."""


def write_error(
    what: str, error: OSError, target: Path, otherwise: type[DemorecError], *, reason: str = ""
) -> DemorecError:
    """Return the error to raise for a target that cannot be written: ConfigError if the user must choose another.

    Args:
        what: Subject of the sentence ("The dataset").
        error: Exception raised while writing.
        target: The path that the user named.
        otherwise: Error type for all other reasons.
        reason: Reason in words; "" for the operating system's.
    """
    kind = ConfigError if error.errno in _UNUSABLE else otherwise
    return kind(f"{what} cannot be written ({reason or error.strerror or error}): {target}")


_MAX_WORDS = 300
"""Maximum length in characters: an error may quote a file's content."""
_PLAIN_WORDS: tuple[tuple[type[BaseException], str], ...] = (
    (UnicodeDecodeError, "it is not UTF-8 text"),
    (RecursionError, "its values are nested too deeply"),
    (struct.error, "it ends within a value"),
    (EOFError, "it ends too early"),
    (IndexError, "it has fewer values than it should"),
    (TypeError, "a value is of another kind than expected"),
    (AttributeError, "a value is of another kind than expected"),
    (ArithmeticError, "a number is out of range"),
)
"""Meaning of Python's errors for a file being read; their own messages describe the code that reads it."""


def describe_error(error: BaseException) -> str:
    """Describe an error of Python or a library in terms of the data, for use inside a sentence.

    Contains no class name, error number or path: the enclosing sentence has the path.
    """
    if isinstance(error, DemorecError):
        return str(error)
    reason = getattr(error, "strerror", None)  # set by system errors and FFmpeg's
    if isinstance(reason, str) and reason:
        return reason
    if isinstance(error, json.JSONDecodeError):
        return f"it is not valid JSON, line {error.lineno}"
    if isinstance(error, KeyError) and error.args:
        return f"it has no {error.args[0]!r}"[:_MAX_WORDS]
    for kind, words in _PLAIN_WORDS:
        if isinstance(error, kind):
            return words
    lines = str(error).split("\n", 1)
    if "set_int_max_str_digits" in lines[0]:
        return "a whole number has too many digits"
    return lines[0].rstrip(".")[:_MAX_WORDS] or "no reason is given"


def without_path(message: BaseException | str, path: Path) -> str:
    """Message of a demorec error without the path at its end, and with files below it relative to it, for a sentence
    that already names the path.
    """
    text = str(message).removesuffix(f": {path}")
    return re.sub(rf"(?<![^\s('\"]){re.escape(str(path))}/", "", text)


def as_reason(error: BaseException) -> str:
    """Message of an error as the rest of a sentence, after "since"."""
    text = describe_error(error)
    return text[:1].lower() + text[1:].rstrip(".")


def error_chain(error: BaseException) -> Iterator[BaseException]:
    """Iterate over an error, its cause, that one's cause, and so on."""
    cause: BaseException | None = error
    seen: list[BaseException] = []
    while cause is not None and cause not in seen:
        yield cause
        seen.append(cause)
        cause = cause.__cause__ or cause.__context__


class MissingDependencyError(DemorecError):
    """An optional package is not installed: the feature that needs it ("The Ray executor"), its name, the command."""

    def __init__(self, feature: str, package: str, remedy: str) -> None:
        super().__init__(feature, package, remedy)

    def __str__(self) -> str:
        feature, package, remedy = self.args
        return f"{feature} needs the package {package!r}, which is not installed: {remedy}."
