"""Everything that can be imported, opened as recordings: bags, HDF5 files, LeRobot datasets.

Reading is importing, into a temporary run that is removed when the context ends, however it ends. So every command
reads what `demorec import` reads, by the same mapping, and says the same of it.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from demorec.core.errors import ConfigError
from demorec.core.plain import listed
from demorec.runs.find import PathKind, find
from demorec.sources.bag import bags_in
from demorec.sources.bag_files import BagError
from demorec.sources.dataset_import import import_lerobot
from demorec.sources.hdf5_import import import_hdf5
from demorec.sources.hdf5_suggest import suggested_hdf5_mapping
from demorec.sources.import_file import dropped_lines
from demorec.sources.import_run import import_bags
from demorec.sources.mapping import SourceMapping
from demorec.sources.mapping_file import read_mapping
from demorec.sources.suggest import suggested_mapping

_MB = 1e6
_MOST_SHOWN = 6
"""Features and cameras of a suggested mapping that are named."""
_NEEDS_MAPPING: tuple[PathKind, ...] = ("hdf5", "rosbag")


@contextmanager
def opened(
    paths: Sequence[Path],
    mapping: Path | None,
    *,
    imports_datasets: bool,
    tell: Callable[[str], None],
) -> Iterator[list[Path]]:
    """Give for each path a run of its episodes, or the path itself where that is read as it is.

    Args:
        paths: Recordings, runs, folders of recordings, datasets, HDF5 files, bags and folders of bags.
        mapping: Of the bags and HDF5 files; None where the one that `demorec import --suggest` writes leaves nothing to
            decide.
        imports_datasets: Whether datasets are opened as recordings.
        tell: Called with what was left out, and by which mapping, a line each.

    Raises:
        ConfigError: A mapping is missing, given for what needs none, or impossible; or the disk is too small.
        DemorecError: As `import_bags`, `import_hdf5` and `import_lerobot`.
    """
    kinds = [_import_kind(path, imports_datasets) for path in paths]
    if mapping is not None and not any(kind in _NEEDS_MAPPING for kind in kinds):
        raise ConfigError(f"Only bags and HDF5 files are read by a mapping: leave --mapping out: {paths[0]}")
    with tempfile.TemporaryDirectory(prefix="demorec-reading-", ignore_cleanup_errors=True) as folder:
        _check_space([path for path, kind in zip(paths, kinds, strict=True) if kind], Path(folder))
        found = []
        for number, (path, kind) in enumerate(zip(paths, kinds, strict=True)):
            if kind is None:
                found.append(path)
                continue
            run = Path(folder) / str(number) / path.resolve().name
            run.parent.mkdir()
            if kind == "dataset":
                for line in import_lerobot(path, run).left_out_lines():
                    tell(line)
            else:
                chosen = mapping or _suggested(path, kind, Path(folder) / f"{number}.toml", tell)
                _import(path, kind, chosen, run, tell)
            found.append(run)
        yield found


def _import_kind(path: Path, imports_datasets: bool) -> PathKind | None:
    """What a path is to be imported as; None for what is read as it is, and for what no command reads."""
    kind = find(path).kind
    if kind == "dataset":
        return kind if imports_datasets else None
    return kind if kind in _NEEDS_MAPPING else None


def _check_space(paths: Sequence[Path], folder: Path) -> None:
    """ConfigError unless there is room for what is read: encoded images stay as they are, pixels become smaller."""
    files = [file for path in paths for file in ([path] if path.is_file() else path.rglob("*")) if file.is_file()]
    needed, free = sum(file.stat().st_size for file in files), shutil.disk_usage(folder).free
    if needed > free:
        raise ConfigError(
            f"Reading this takes up to {needed / _MB:,.0f} MB in {folder.parent}, where {free / _MB:,.0f} MB are free: "
            f"set TMPDIR to a folder on a larger disk: {paths[0]}"
        )


def _suggested(path: Path, kind: PathKind, target: Path, tell: Callable[[str], None]) -> Path:
    """The mapping that --suggest writes, where it can be used as it is.

    Raises:
        ConfigError: It leaves something to the user.
    """
    doubts: list[str] = []
    is_hdf5 = kind == "hdf5"
    lines = suggested_hdf5_mapping(path) if is_hdf5 else suggested_mapping(bags_in(path)[0], doubts.append)
    target.write_text("\n".join(lines) + "\n", encoding="utf-8")
    suggest = f"demorec import {'hdf5 ' if is_hdf5 else ''}{path} --suggest > mapping.toml"
    try:
        if doubts:
            raise ConfigError(doubts[0])
        used = read_mapping(target, "hdf5" if is_hdf5 else "bag")
    except ConfigError as error:
        reason = str(error).removesuffix(f": {target}")
        raise ConfigError(
            f"This is read by a mapping (--mapping FILE), and the suggested one leaves something to you: {reason}; "
            f"{suggest} writes it: {path}"
        ) from error
    tell(f"{path}: read by the suggested mapping ({_taken(used)}); {suggest} writes it, --mapping takes another.")
    return target


def _taken(mapping: SourceMapping) -> str:
    """What a mapping takes, in a line."""
    parts = [
        f"{name} from {' and '.join(dict.fromkeys(source.place for source in of))}"
        for name, of in mapping.features.items()
    ]
    return listed([*parts, *(f"camera {name}" for name in mapping.cameras)], _MOST_SHOWN, ", ")


def _import(path: Path, kind: PathKind, mapping: Path, run: Path, tell: Callable[[str], None]) -> None:
    if kind == "hdf5":
        for line in import_hdf5([path], mapping, run).left_out_lines():
            tell(line)
        return
    result = import_bags([path], mapping, run)
    for report in result.reports:
        for line in dropped_lines(report):
            tell(f"{report.name}: {line}")
    if not any(row.episode_index is not None for report in result.reports for row in report.episodes):
        raise BagError(f"The mapping makes no episode of this, so there is nothing to read: {path}")
