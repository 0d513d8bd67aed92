"""An HDF5 file of unknown origin is read in a process of its own first, which the HDF5 library may end.

HDF5 2.0 believes the lengths that a damaged file claims for its texts: it copies gigabytes of what is behind them in
memory, or crashes, and on some files it never ends. So a process that can be spared walks through the file before we
open it: through all that `demorec.hdf5.foreign` is asked for, and of numbers in chunks through the first and last rows,
since those between them are found in the same way. What the library refuses with an error is told when it is read.
"""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import h5py

MAX_ATTRIBUTE_BYTES = 16 << 20
MAX_OBJECTS = 100_000
_MAX_ROW_BYTES = 64 << 20
_MEMORY_BYTES = 1 << 29
"""Beside what a process has when it begins; rows and texts within the limits take less."""
_WALK_SECONDS = 20.0
"""Of CPU time, after which a walk ends: tens of thousands of objects were whole."""
_END_SECONDS = 40
"""Of CPU time, after which the process ends: a single call into the library has not returned."""
_TOO_MUCH = 3
"""Exit code when something in the file claims more memory than there is."""


def why_not_read(path: Path) -> str:
    """Why a file is left alone, for the inside of a sentence, or ""; tried once for each state of a file."""
    state = path.stat()
    return _tried(path.absolute(), (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns))


@lru_cache(maxsize=1024)
def _tried(path: Path, state: tuple[int, ...]) -> str:
    command = [sys.executable, "-P", "-m", __name__, str(path)]
    code = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False).returncode
    if code == _TOO_MUCH:
        return "it is damaged: a length in it is larger than what it holds"
    if code == -signal.SIGXCPU:
        return "it is damaged: the HDF5 library does not come to an end with it"
    return "it is damaged: the HDF5 library crashes when it reads it" if code < 0 else ""


def walk(path: Path) -> None:
    """Read what `ForeignFile` may be asked for; MemoryError where something is claimed to be too large for that."""
    with _errors_ignored(), h5py.File(path, "r", locking=False) as file:
        for found in _objects(file.id):
            with _errors_ignored():
                for number in range(h5py.h5a.get_num_attrs(found)):
                    with _errors_ignored():
                        _read_attribute(found, h5py.h5a.open(found, index=number))
            if isinstance(found, h5py.h5d.DatasetID):
                with _errors_ignored():
                    _read_dataset(found)


@contextmanager
def _errors_ignored() -> Iterator[None]:
    try:
        yield
    except Exception as error:
        # HDF5 says it in an error of any kind ("memory allocation failed").
        if isinstance(error, MemoryError) or "memory alloc" in str(error):
            raise MemoryError from error


def _objects(file: h5py.h5f.FileID) -> Iterator[h5py.h5g.GroupID | h5py.h5d.DatasetID]:
    """Everything that hard links lead to, once; by h5py's lower level, which takes a fraction of the other's time."""
    end = time.process_time() + _WALK_SECONDS
    waiting = [h5py.h5g.open(file, b"/")]
    seen: set[int] = set()
    while waiting and len(seen) < MAX_OBJECTS:
        if len(seen) % 256 == 0 and time.process_time() > end:  # asking takes as long as looking
            return
        found = waiting.pop()
        address = h5py.h5o.get_info(found).addr
        if address in seen:
            continue
        seen.add(address)
        yield found
        if isinstance(found, h5py.h5g.GroupID) and found.get_num_objs() <= MAX_OBJECTS:
            for name in found:
                with _errors_ignored():
                    if found.links.get_info(name).type == h5py.h5l.TYPE_HARD:
                        waiting.append(h5py.h5o.open(found, name))


def _read_attribute(found: h5py.h5g.GroupID | h5py.h5d.DatasetID, attribute: h5py.h5a.AttrID) -> None:
    is_empty = attribute.get_space().get_simple_extent_type() == h5py.h5s.NULL
    if is_empty or attribute.shape not in ((), (1,)) or attribute.get_storage_size() > MAX_ATTRIBUTE_BYTES:
        return
    value = h5py.AttributeManager(h5py.Group(found) if isinstance(found, h5py.h5g.GroupID) else h5py.Dataset(found))[
        attribute.name
    ]
    if isinstance(value, str | bytes) and len(value) > MAX_ATTRIBUTE_BYTES:
        raise MemoryError


def _read_dataset(found: h5py.h5d.DatasetID) -> None:
    """What is not simply a stretch of the file: texts, and chunks, of which the first and the last are read."""
    found.get_storage_size()
    is_chunked = found.get_create_plist().get_layout() == h5py.h5d.CHUNKED
    if is_chunked:
        found.get_num_chunks()
    is_text = found.get_type().get_class() == h5py.h5t.STRING
    if not found.shape or not (is_chunked or is_text):
        return
    dataset = h5py.Dataset(found)
    if is_text and len(dataset) <= MAX_OBJECTS:
        dataset[:]
    elif is_chunked and dataset.size and dataset.nbytes // len(dataset) * dataset.chunks[0] <= _MAX_ROW_BYTES:
        for index in (0, -1):
            with _errors_ignored():
                dataset[index]


def main() -> int:
    """Of the process that can be spared."""
    begun = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (begun + _MEMORY_BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_CPU, (_END_SECONDS, _END_SECONDS + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        walk(Path(sys.argv[1]))
    except MemoryError:
        return _TOO_MUCH
    return 0


if __name__ == "__main__":
    sys.exit(main())
