"""An HDF5 file of unknown origin is read in a process of its own first, which the HDF5 library may end.

HDF5 2.0 believes the lengths that a damaged file claims for its texts: it copies gigabytes of what is behind them in
memory, or crashes, and on some files it never ends. So a process that can be spared walks through the file before we
open it: through all that `demorec.datasets.hdf5.foreign` is asked for, and of numbers in chunks through the first and
last rows, since those between them are found in the same way (rows of variable length are not). What the library
refuses with an error is reported when it is read.
"""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path

import h5py

from demorec.core.errors import ResourceError
from demorec.core.processes import start_program

MAX_ATTRIBUTE_BYTES = 16 << 20
MAX_OBJECTS = 100_000
MAX_NAME = 1000
"""Characters of each text in a list of texts."""
_MAX_ROW_BYTES = 64 << 20
_MEMORY_BYTES = 1 << 29
"""Beside what a process has when it begins; rows and texts within the limits take less."""
_WALK_SECONDS = 4.0
"""Of CPU time, after which a walk ends: some twenty thousand objects and attributes were whole."""
_END_SECONDS = 7
"""Of CPU time, after which the process ends: a single call into the library has not returned."""
_PATIENCE_S = 300.0
"""Of waiting for the process, which may wait for a disk itself."""
_TOO_MUCH = 65
"""Exit code when something in the file claims more memory than there is; no signal has that number."""
_CRASHES = {signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGFPE, signal.SIGILL}


def why_not_read(path: Path) -> str:
    """Why a file is left alone, for the inside of a sentence, or ""; tried once for each state of a file.

    Raises:
        ResourceError: It could not be tried.
    """
    state = path.stat()
    return _tried(path.absolute(), (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns))


@lru_cache(maxsize=1024)
def _tried(path: Path, state: tuple[int, ...]) -> str:
    command = [sys.executable, "-P", "-m", __name__, str(path)]
    with start_program(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            code = abs(process.wait(_PATIENCE_S))
        except subprocess.TimeoutExpired:
            code = signal.SIGTERM
        finally:
            process.terminate()
    if code == _TOO_MUCH:
        return f"it is damaged, or has texts of more than {_MEMORY_BYTES >> 20} MB"
    if code == signal.SIGXCPU:
        return "it is damaged: the HDF5 library does not come to an end with it"
    if code in _CRASHES:
        return "it is damaged: the HDF5 library crashes when it reads it"
    if code:  # another time it may be another one: not kept
        raise ResourceError(
            f"The HDF5 file could not be tried in a process of its own, which ended with {code}; is there too little "
            f"memory? {path}"
        )
    return ""


def walk(path: Path) -> None:
    """Read what `ForeignFile` may be asked for; MemoryError where something is claimed to be too large for that."""
    end = time.process_time() + _WALK_SECONDS
    with _errors_ignored(), h5py.File(path, "r", locking=False) as file:
        for found in _objects(file.id, end):
            names: list[bytes] = []
            with _errors_ignored():
                h5py.h5a.iterate(found, names.append)  # by number each would be looked for among all
            for number, name in enumerate(names):
                if number % 256 == 255 and time.process_time() > end:
                    return
                with _errors_ignored():
                    _read_attribute(found, h5py.h5a.open(found, name))
            if isinstance(found, h5py.h5d.DatasetID):
                with _errors_ignored():
                    _read_dataset(found, end)


@contextmanager
def _errors_ignored() -> Iterator[None]:
    try:
        yield
    except Exception as error:
        # HDF5 says it in an error of any kind ("memory allocation failed").
        if isinstance(error, MemoryError) or "memory alloc" in str(error):
            raise MemoryError from error


def _objects(file: h5py.h5f.FileID, end: float) -> Iterator[h5py.h5g.GroupID | h5py.h5d.DatasetID]:
    """Everything that hard links lead to, once; by h5py's lower level, which takes a fraction of the other's time.

    Nothing is held open but the groups on the way down: the library keeps up to 85 kB of each open dataset.
    """
    root = h5py.h5g.open(file, b"/")
    yield root
    groups = [(root, _names(root))]
    seen = {h5py.h5o.get_info(root).addr}
    while groups and len(seen) < MAX_OBJECTS:
        if len(seen) % 256 == 0 and time.process_time() > end:  # asking takes as long as looking
            return
        group, names = groups[-1]
        if not names:
            groups.pop()
            continue
        with _errors_ignored():
            name = names.pop()
            if group.links.get_info(name).type != h5py.h5l.TYPE_HARD:
                continue
            address = h5py.h5o.get_info(group, name).addr
            if address in seen:
                continue
            seen.add(address)
            found = h5py.h5o.open(group, name)
            yield found
            if isinstance(found, h5py.h5g.GroupID):
                groups.append((found, _names(found)))


def _names(group: h5py.h5g.GroupID) -> list[bytes]:
    with _errors_ignored():
        return list(group) if group.get_num_objs() <= MAX_OBJECTS else []
    return []


def is_single(attribute: h5py.h5a.AttrID) -> bool:
    """Whether an attribute has one value, which is not too large to be read."""
    is_empty = attribute.get_space().get_simple_extent_type() == h5py.h5s.NULL
    return not is_empty and attribute.shape in ((), (1,)) and attribute.get_storage_size() <= MAX_ATTRIBUTE_BYTES


def _read_attribute(found: h5py.h5g.GroupID | h5py.h5d.DatasetID, attribute: h5py.h5a.AttrID) -> None:
    if is_single(attribute):
        owner = h5py.Group(found) if isinstance(found, h5py.h5g.GroupID) else h5py.Dataset(found)
        owner.attrs[attribute.name]


def _read_dataset(found: h5py.h5d.DatasetID, end: float) -> None:
    """What is not simply a stretch of the file: texts, and chunks, of which the first and the last are read."""
    found.get_storage_size()
    is_chunked = found.get_create_plist().get_layout() == h5py.h5d.CHUNKED
    if is_chunked:
        found.get_num_chunks()
    is_text = found.get_type().get_class() == h5py.h5t.STRING
    is_ragged = found.get_type().get_class() == h5py.h5t.VLEN
    if not found.shape or not (is_chunked or is_text or is_ragged):
        return
    dataset = h5py.Dataset(found)
    if is_ragged:  # every row has a place of its own in the file, unless it was made to share one
        left = Path(dataset.file.filename).stat().st_size
        for index in range(len(dataset) if dataset.ndim == 1 else 0):
            with _errors_ignored():
                left -= len(dataset[index])
            if left < 0 or time.process_time() > end:
                return
        return
    if is_text:
        kind = h5py.check_string_dtype(dataset.dtype)
        if dataset.ndim == 1 and len(dataset) <= MAX_OBJECTS and kind is not None and (kind.length or 0) <= MAX_NAME:
            dataset[:]
    elif is_chunked and dataset.size and dataset.nbytes // len(dataset) * dataset.chunks[0] <= _MAX_ROW_BYTES:
        for index in (0, -1):
            with _errors_ignored():
                dataset[index]


def _limit(what: int, value: int) -> None:
    """Set a limit, unless there is a lower one."""
    hard = resource.getrlimit(what)[1]
    resource.setrlimit(what, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


def main() -> int:
    """Of the process that can be spared."""
    with suppress(OSError, ValueError):  # only Linux tells what a process has, and holds it to a limit
        begun = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        _limit(resource.RLIMIT_AS, begun + _MEMORY_BYTES)
    _limit(resource.RLIMIT_CPU, _END_SECONDS)
    _limit(resource.RLIMIT_CORE, 0)
    try:
        walk(Path(sys.argv[1]))
    except MemoryError:
        return _TOO_MUCH
    return 0


if __name__ == "__main__":
    sys.exit(main())
