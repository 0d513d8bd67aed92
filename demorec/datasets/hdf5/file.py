"""HDF5 files: made anew so that no failure harms, and known by their content, so that nothing else is ever replaced."""

from __future__ import annotations

import errno
import io
import json
import re
from pathlib import Path
from types import TracebackType
from typing import Self

import h5py

from demorec.core.errors import describe_error
from demorec.core.files import HDF5_MAGIC, open_regular
from demorec.core.replacing import ReplaceableKind
from demorec.episode.sensed import SENSED

ENV_ARGUMENTS = frozenset({"robot", "fps", "physics_hz", "cameras", "action", "privileged"})
"""What `env_args` says of every environment of ours, by which our files are known."""
IMAGE_ARGUMENTS = frozenset({"width", "height"})
"""What it says of environments with cameras beside."""
EXTERNAL_ENVIRONMENT = "demorec/collected"
"""What stands for an environment in files of external episodes, which have none."""
EXTERNAL_ARGUMENTS = frozenset({"robot", "fps", "cameras", "observations"})
"""What `env_args` says beside it."""
_OBSERVATIONS = "|".join(
    (
        r"robot0_(joint_pos|joint_vel|gripper_qpos|gripper_qvel|eef_pos|eef_quat)|object|command|[^/]+_(image|depth)",
        *(re.escape(name.removeprefix("observation.")) for name in SENSED),
    )
)
_PARTS = r"data|mask|mask/(train|valid)|data/demo_\d+(/(actions|states|rewards|dones|obs))?|data/demo_\d+/obs/({names})"
_ATTRIBUTES = (
    ("data", frozenset({"env_args", "total", "task", "fps"})),
    (
        r"data/demo_\d+",
        frozenset({"num_samples", "instruction", "episode_index", "attempt", "success", "model_file", "origin"}),
    ),
    (r"data/demo_\d+/(actions|states|obs/({names}))", frozenset({"names"})),
)
"""All that an export writes: names of groups and datasets, and of the attributes that they have."""


def _begins_as_hdf5(path: Path) -> bool:
    with open_regular(path) as file:
        return file.read(len(HDF5_MAGIC)) == HDF5_MAGIC


def _is_our_dataset(path: Path) -> bool:
    if not _begins_as_hdf5(path):
        return False
    try:
        with h5py.File(path, "r", locking=False) as file:
            data = file.get("data")
            if not isinstance(data, h5py.Group) or not {"total", "env_args"} <= set(data.attrs):
                return False
            described = json.loads(data.attrs["env_args"])
            given = set(described["env_kwargs"])
            if described["env_name"] == EXTERNAL_ENVIRONMENT:
                return given == EXTERNAL_ARGUMENTS
            return str(described["env_name"]).startswith("demorec/") and given - IMAGE_ARGUMENTS == ENV_ARGUMENTS
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, RecursionError):
        return False


def _strangers(path: Path) -> list[str]:
    """Groups, datasets and attributes that no export writes."""
    found: list[str] = []

    def look(name: str, link: object) -> None:
        if not isinstance(link, h5py.HardLink) or not parts.fullmatch(name):
            found.append(name)
            return
        allowed = next((names for place, names in attributes if place.fullmatch(name)), frozenset[str]())
        found.extend(f"attribute {key} of {name}" for key in file[name].attrs if key not in allowed)

    try:
        with h5py.File(path, "r", locking=False) as file:
            names = _observation_pattern(file)
            parts = re.compile(_PARTS.replace("{names}", names))
            attributes = [(re.compile(place.replace("{names}", names)), keys) for place, keys in _ATTRIBUTES]
            found += [f"attribute {key}" for key in file.attrs]
            file.visititems_links(look)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise OSError(errno.EIO, describe_error(error)) from error
    return found


def _observation_pattern(file: h5py.File) -> str:
    """The observations that the export has written: of external episodes the file itself names them."""
    described = json.loads(file["data"].attrs["env_args"])
    if described["env_name"] != EXTERNAL_ENVIRONMENT:
        return _OBSERVATIONS
    return "|".join(re.escape(str(name)) for name in described["env_kwargs"]["observations"])


DATASET = ReplaceableKind(
    name="a robomimic dataset (HDF5) by demorec", recognises=_is_our_dataset, strangers=_strangers
)
UNFINISHED = ReplaceableKind(name="an HDF5 file", recognises=_begins_as_hdf5)
"""What a killed export leaves (`NewFile` sees to its first bytes)."""


class _Storage(io.FileIO):
    """A file whose writes never fail: the first error is kept, and what is written after it goes nowhere.

    The HDF5 library ends the process with a segmentation fault when it cannot write what it still holds on closing.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "r+")
        self.error: BaseException | None = None

    def write(self, data: memoryview) -> int:  # type: ignore[override]
        left = memoryview(data)
        try:
            while self.error is None and left:
                left = left[super().write(left) :]
        except BaseException as error:  # an interrupt, too, must not reach HDF5
            self.error = error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        try:
            if self.error is None:
                return super().truncate(size)
        except BaseException as error:
            self.error = error
        return 0 if size is None else size


class NewFile:
    """Context manager: an HDF5 file written over what is at a path, which must exist and be locked by the caller.

    Attributes:
        root: Its root group.

    Raises:
        OSError: It cannot be written; so do `flush` and the end of the block.
    """

    def __init__(self, path: Path) -> None:
        self._storage = _Storage(path)
        self.root = h5py.File(self._storage, "w")
        # HDF5 writes its first bytes late; without them nobody would know whose file a killed export has left.
        self._storage.seek(0)
        self._storage.write(memoryview(HDF5_MAGIC))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.root.close()
        self._storage.close()
        if exc is None:
            self._raise_error()

    def flush(self) -> None:
        """Write what is still in memory; raise the error of any write since the last time."""
        self.root.flush()
        self._raise_error()

    def _raise_error(self) -> None:
        if self._storage.error is not None:
            raise self._storage.error
