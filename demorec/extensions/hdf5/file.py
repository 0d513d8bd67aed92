"""HDF5 files: written to a new file so that failures do no harm, and recognised by content before they are replaced."""

from __future__ import annotations

import errno
import io
import json
import re
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType

import h5py

from demorec.core.errors import describe_error
from demorec.core.files import HDF5_MAGIC, open_regular
from demorec.core.replacing import ReplaceableKind

ENVIRONMENT_PREFIX = "demorec/"
"""Prefix of `env_name` in `env_args`, which marks a file as an export."""
_PARTS: dict[str, tuple[str, ...]] = {
    "mask": (),
    "mask/train": (),
    "mask/valid": (),
    "data": ("env_args", "total", "fps", "observations"),
    "data/demo_N": ("num_samples", "instruction", "success", "model_file"),
    "data/demo_N/actions": ("names",),
    "data/demo_N/states": ("names",),
    "data/demo_N/rewards": (),
    "data/demo_N/dones": (),
    "data/demo_N/obs": (),
    "data/demo_N/obs/NAME": ("names",),
}
"""Groups and datasets of an export -> their attributes. `observations` lists the NAMEs (JSON)."""
_DEMO = re.compile(r"data/demo_\d+(?=/|$)")


def _is_our_dataset(path: Path) -> bool:
    with open_regular(path) as file:
        if file.read(len(HDF5_MAGIC)) != HDF5_MAGIC:
            return False
    try:
        with h5py.File(path, "r", locking=False) as file:
            data = file.get("data")
            if not isinstance(data, h5py.Group) or not {"total", "env_args"} <= set(data.attrs):
                return False
            return str(json.loads(data.attrs["env_args"])["env_name"]).startswith(ENVIRONMENT_PREFIX)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, RecursionError):
        return False


def _strangers(path: Path) -> list[str]:
    """Groups, datasets and attributes that no export writes."""
    found: list[str] = []

    def look(name: str, link: object) -> None:
        place = _DEMO.sub("data/demo_N", name)
        if place in observations:
            place = "data/demo_N/obs/NAME"
        if not isinstance(link, h5py.HardLink) or place not in _PARTS:
            found.append(name)
            return
        found.extend(f"attribute {key} of {name}" for key in file[name].attrs if key not in _PARTS[place])

    try:
        with h5py.File(path, "r", locking=False) as file:
            names = json.loads(file["data"].attrs["observations"])
            observations = {f"data/demo_N/obs/{name}" for name in names}
            found += [f"attribute {key}" for key in file.attrs]
            file.visititems_links(look)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, RecursionError) as error:
        raise OSError(errno.EIO, describe_error(error)) from error
    return found


DATASET = ReplaceableKind(
    name="a robomimic dataset (HDF5) by demorec", recognises=_is_our_dataset, strangers=_strangers
)


class _Storage(io.FileIO):
    """A file object with writes that never raise: it keeps the first error and discards later data.

    The HDF5 library ends the process with a segmentation fault if it cannot write its buffers on closing.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "x+")
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
        return size or 0


class NewFile(AbstractContextManager["NewFile"]):
    """Context manager for an HDF5 file at a new path, with the group `root`.

    An OSError is raised by `flush`, or at the end of the block.
    """

    def __init__(self, path: Path) -> None:
        self._storage = _Storage(path)
        self.root = h5py.File(self._storage, "w")

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.root.close()
        self._storage.close()
        if exc is None:
            self._raise_error()

    def flush(self) -> None:
        """Flush the buffers; raise the first error of any write since the last call."""
        self.root.flush()
        self._raise_error()

    def _raise_error(self) -> None:
        if self._storage.error is not None:
            raise self._storage.error
