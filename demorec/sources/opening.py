"""Everything that can be imported, opened as recordings: bags and the rows of `demorec.sources.formats`.

Reading is importing, into a temporary run that is removed when the context ends, however it ends. So every command
reads what `demorec import` reads, by the same mapping, and says the same of it.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.plain import listed
from demorec.runs.find import IMPORT_WORDS, PathKind, find
from demorec.sources.bag import bags_in
from demorec.sources.bag_files import BagError
from demorec.sources.formats import FORMATS, IMPORTED
from demorec.sources.import_file import dropped_lines
from demorec.sources.import_run import import_bags
from demorec.sources.mapping import SourceMapping
from demorec.sources.mapping_file import read_mapping
from demorec.sources.suggest import suggested_mapping

_MB = 1e6
_MOST_SHOWN = 6
"""Features and cameras of a suggested mapping that are named."""


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
        paths: Recordings, runs, folders of recordings, and whatever can be imported.
        mapping: Of the bags and files that need one; None where the one that `demorec import --suggest` writes leaves
            nothing to decide.
        imports_datasets: Whether datasets are opened as recordings.
        tell: Called with what was left out, and by which mapping, a line each.

    Raises:
        ConfigError: A mapping is missing, given for what needs none, or impossible; or the disk is too small.
        DemorecError: As `import_bags` and `SourceFormat.read`.
    """
    kinds = [_import_kind(path, imports_datasets) for path in paths]
    if mapping is not None and not any(_needs_mapping(kind) for kind in kinds):
        mapped = " and ".join(["bags", *(form.name for form in FORMATS.values() if form.mapping)])
        raise ConfigError(f"Only {mapped} are read by a mapping: leave --mapping out: {paths[0]}")
    with tempfile.TemporaryDirectory(prefix="demorec-reading-", ignore_cleanup_errors=True) as folder:
        _check_space([path for path, kind in zip(paths, kinds, strict=True) if kind], Path(folder))
        found = []
        for number, (path, kind) in enumerate(zip(paths, kinds, strict=True)):
            if kind is None:
                found.append(path)
                continue
            run = Path(folder) / str(number) / path.resolve().name
            run.parent.mkdir()
            chosen = None
            if _needs_mapping(kind):
                chosen = mapping or _suggested(path, kind, Path(folder) / f"{number}.toml", tell)
            if kind in IMPORT_WORDS:
                for line in FORMATS[IMPORT_WORDS[kind]].read([path], chosen, run, VideoConfig(), None).left_out_lines():
                    tell(line)
            elif chosen is not None:
                _import_bag(path, chosen, run, tell)
            found.append(run)
        yield found


def _import_kind(path: Path, imports_datasets: bool) -> PathKind | None:
    """What a path is to be imported as; None for what is read as it is, and for what no command reads."""
    kind = find(path).kind
    return kind if kind in IMPORTED or (imports_datasets and kind == "dataset") else None


def _needs_mapping(kind: PathKind | None) -> bool:
    if kind is None or kind not in IMPORT_WORDS:
        return kind == "rosbag"
    return FORMATS[IMPORT_WORDS[kind]].mapping is not None


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
    word = IMPORT_WORDS.get(kind, "")
    form = FORMATS.get(word)
    lines = form.suggest(path) if form else suggested_mapping(bags_in(path)[0], doubts.append)
    target.write_text("\n".join(lines) + "\n", encoding="utf-8")
    suggest = f"demorec import {f'{word} ' if word else ''}{path} --suggest > mapping.toml"
    try:
        if doubts:
            raise ConfigError(doubts[0])
        used = read_mapping(target, (form and form.mapping) or "bag")
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


def _import_bag(path: Path, mapping: Path, run: Path, tell: Callable[[str], None]) -> None:
    result = import_bags([path], mapping, run)
    for report in result.reports:
        for line in dropped_lines(report):
            tell(f"{report.name}: {line}")
    if not any(row.episode_index is not None for report in result.reports for row in report.episodes):
        raise BagError(f"The mapping makes no episode of this, so there is nothing to read: {path}")
