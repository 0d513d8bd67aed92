"""Errors: what the machine lacks is kept apart from what the data are."""

from __future__ import annotations

import errno
import pickle
from pathlib import Path

import pytest
from support.present import present

from demorec.errors import RecordingError, ResourceError, resource_error


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError(), "memory"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "memory"),
        (OSError(errno.EMFILE, "Too many open files"), "ulimit -n"),
        (OSError(errno.ENFILE, "Too many open files in system"), "open on this machine"),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), "memory"),
        (ImportError("libz.so: cannot open shared object file: Too many open files"), "ulimit -n"),
        (OSError("libllvmlite.so: failed to map segment from shared object"), "memory"),
        (OSError(errno.EIO, "Input/output error"), "storage"),
    ],
)
def test_what_the_machine_lacks_is_told_as_such_however_it_is_wrapped(
    tmp_path: Path, error: Exception, words: str
) -> None:
    def wrapped() -> RuntimeError:
        try:
            try:
                raise error
            except type(error) as cause:
                raise ValueError("a library") from cause
        except ValueError:
            try:
                raise RuntimeError("another library")
            except RuntimeError as outer:
                return outer

    for raised in (error, wrapped()):
        found = present(resource_error(raised, tmp_path))
        assert words in str(found)
        assert str(found).endswith(f"whether the file is sound is not known: {tmp_path}")
        assert resource_error(found) is found
        assert str(pickle.loads(pickle.dumps(found))) == str(found)
    assert not isinstance(found, RecordingError)


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOENT, "none"), OSError("?"), ValueError(), RecordingError("damaged"), ImportError("none")]
)
def test_every_other_error_is_left_alone(error: Exception) -> None:
    assert resource_error(error) is None


def test_without_a_file_nothing_is_said_of_one() -> None:
    assert str(resource_error(MemoryError())).endswith("(ulimit -v).")
    assert ResourceError("x").exit_code == 1
