"""Errors distinguish a shortage of the machine from damaged data."""

from __future__ import annotations

import errno
import json
import pickle
import struct
from pathlib import Path

import av
import pytest
from support.present import present

from demorec.core.errors import RecordingError, describe_error, resource_error, without_path


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError(), "memory"),
        (OSError(errno.EMFILE, "Too many open files"), "ulimit -n"),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), "memory"),
        (ImportError("libz.so: cannot open shared object file: Too many open files"), "ulimit -n"),
        (OSError(errno.EIO, "Input/output error"), "storage"),
    ],
)
def test_shortages_are_recognised_in_wrapped_errors(tmp_path: Path, error: Exception, words: str) -> None:
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


def _raised(code: str) -> Exception:
    scope = {"json": json, "struct": struct, "av": av, "Path": Path}
    try:
        exec(code, scope)
    except Exception as error:
        return error
    raise AssertionError(f"nothing was raised by {code}")


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("{}['fps']", "it has no 'fps'"),
        ("json.loads('{')", "it is not valid JSON, line 1"),
        ("b'\\xff'.decode()", "it is not UTF-8 text"),
        ("struct.unpack('<Q', b'ab')", "it ends within a value"),
        ("None.items()", "a value is of another kind than expected"),
        ("[][3]", "it has fewer values than it should"),
        ("1 / 0", "a number is out of range"),
        ("av.open('/nothing/at/all')", "No such file or directory"),
        ("raise ValueError('two lines are of episode 3.\\nAnd more.')", "two lines are of episode 3"),
        ("raise ValueError", "no reason is given"),
    ],
)
def test_errors_of_python_are_described_in_words(code: str, words: str) -> None:
    error = _raised(code)
    assert describe_error(error) == words
    assert describe_error(RecordingError("The recording is damaged: a.mcap")) == "The recording is damaged: a.mcap"


def test_a_message_names_files_relative_to_their_folder() -> None:
    """A folder with the short name "a" leaves "meta/info.json" alone."""
    for folder in (Path("a"), Path("/data/a")):
        error = RecordingError(f"meta/info.json and {folder}/meta/tasks.jsonl ('{folder}/data') differ: {folder}")
        assert without_path(error, folder) == "meta/info.json and meta/tasks.jsonl ('data') differ"
