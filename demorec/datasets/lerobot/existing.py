"""Continuing an existing dataset from any writer: compatibility checks and the starting position.

Existing files are never opened for writing; new episodes get new files, as with LeRobot's own `resume`.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

from demorec.core.errors import ConfigError
from demorec.core.extension import kind_function
from demorec.core.replacing import files_below
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, STATS_PATH, TASKS_PATH, DatasetInfo
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.datasets.lerobot.writer import DatasetStart


def start_after(root: Path) -> DatasetStart:
    """Read the state that a writer needs to continue a dataset. Raises ConfigError if no installed extension reads
    datasets, and errors as in the extension.
    """
    if (read := kind_function("dataset", "appender")) is None:
        raise ConfigError(f"No installed extension reads a dataset to append to: export into a new folder: {root}")
    start: DatasetStart = read(root)
    return start


def features_to_append(root: Path, info: DatasetInfo, new: DatasetInfo) -> tuple[str, ...]:
    """Check that a dataset made from the recordings alone, `new`, has every feature of the existing one; return the
    features that only `new` has. Raises ConfigError with all differences.
    """
    offered = new.features
    wrong = []
    if info.fps != new.fps:
        wrong.append(f"fps is {info.fps}, the recordings have {new.fps}")
    if info.robot_type not in (None, new.robot_type):
        wrong.append(f"robot_type is {info.robot_type!r}, the recordings have {new.robot_type!r}")
    for name, feature in info.features.items():
        if name in AUTOMATIC_FEATURES:
            continue
        if name not in offered:
            wrong.append(f"it has {name!r}, which the recordings and these options do not provide")
        else:
            found = feature.differences(offered[name])
            wrong += [f"{name}: {what} is {there}, not {ours}" for what, there, ours in found]
    if wrong:
        raise ConfigError(
            f"These recordings cannot be appended, because the dataset differs: {'; '.join(wrong)}. "
            f"Export into a new folder, or with other options: {root}"
        )
    return tuple(name for name in offered if name not in info.features)


def link_files(source: Path, target: Path) -> None:
    """Link a dataset's finished tables and videos into another folder, or copy them if links are not possible. Only
    files that are never changed in place are linked; files that the writer replaces are left out.
    """
    renewed = (INFO_PATH, STATS_PATH, TASKS_PATH)
    for name in files_below(source):
        if name not in renewed:
            path, copy = source / name, target / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            _link_or_copy(path, copy)


def _link_or_copy(path: Path, copy: Path) -> None:
    if path.suffix in (".parquet", ".mp4") and not path.is_symlink():
        with suppress(OSError):  # another file system, or one without links
            os.link(path, copy)
            return
    shutil.copy2(path, copy)
