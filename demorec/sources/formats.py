"""What is read by importing it: a row a format, and `demorec import` and whatever else reads go by the rows.

Bags have none: `demorec.sources.bag` tells their kinds apart. Other commands read by importing into a temporary run,
which is removed when the context ends, however it ends: by the same mapping as `demorec import`, in the same words.
"""

from __future__ import annotations

import pkgutil
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.plain import listed
from demorec.episode.roles import NO_NAMES, NamedRoles
from demorec.robots.motors import Motors
from demorec.runs.find import IMPORT_WORDS, PathKind, find
from demorec.sources.mapping import SourceKind, SourceMapping

if TYPE_CHECKING:
    from demorec.sources.episode_writer import FramesImport


@dataclass(frozen=True, kw_only=True)
class SourceFormat:
    """Files or folders of other programs whose episodes have evenly spaced frames.

    Attributes:
        kind: What `demorec.runs.find` takes them for.
        name: In a sentence, of many.
        example: What follows `demorec import` and the format's word.
        importer: "module:function", which `read` calls with its arguments.
        mapping: Whose keys its mappings have; None where it needs none, so that its numbers may be those of an arm's
            servos, the user may name the roles of its features, and episodes that cannot be read may be left out.
        suggester: "module:function", path -> the lines of a mapping, where it needs one.
    """

    kind: PathKind
    name: str
    example: str
    importer: str
    mapping: SourceKind | None = None
    suggester: str = ""

    def read(
        self,
        paths: Sequence[Path],
        mapping: Path | None,
        out: Path,
        video: VideoConfig,
        motors: Motors | None = None,
        named: NamedRoles = NO_NAMES,
        *,
        skip_bad: bool = False,
    ) -> FramesImport:
        """Make or continue the run `out`; arguments and errors as of the importer, the last three without a mapping."""
        importer = pkgutil.resolve_name(self.importer)
        own = {} if self.mapping else {"motors": motors, "named": named, "skip_bad": skip_bad}
        return cast("FramesImport", importer(paths, mapping, out, video=video, **own))

    def suggest(self, path: Path) -> list[str]:
        """The lines of a mapping of a format that needs one."""
        return cast(list[str], pkgutil.resolve_name(self.suggester)(path))


_ROWS = (
    SourceFormat(
        kind="dataset",
        name="LeRobot datasets",
        example="datasets/cups --out runs/cups",
        importer="demorec.sources.dataset_import:import_lerobot",
    ),
    SourceFormat(
        kind="hdf5",
        name="HDF5 files",
        example="demo.hdf5 --mapping mapping.toml --out runs/demo",
        importer="demorec.sources.hdf5_import:import_hdf5",
        mapping="hdf5",
        suggester="demorec.sources.hdf5_suggest:suggested_hdf5_mapping",
    ),
)
FORMATS: Mapping[str, SourceFormat] = {IMPORT_WORDS[form.kind]: form for form in _ROWS}
"""The first word after `demorec import` -> the format."""
IMPORTED: tuple[PathKind, ...] = ("rosbag", *(kind for kind in IMPORT_WORDS if kind != "dataset"))
"""Kinds of paths that no command reads as they are. Datasets are, but where recordings are needed (export)."""
_MB = 1e6
_MOST_SHOWN = 6
"""Features and cameras of a suggested mapping that are named."""


@contextmanager
def opened(
    paths: Sequence[Path], mapping: Path | None, *, imports_datasets: bool, tell: Callable[[str], None]
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
    kinds = [import_kind(path, imports_datasets) for path in paths]
    forms = [FORMATS.get(IMPORT_WORDS.get(kind, "")) if kind else None for kind in kinds]
    if mapping is not None and "rosbag" not in kinds and not any(form and form.mapping for form in forms):
        mapped = " and ".join(["bags", *(form.name for form in FORMATS.values() if form.mapping)])
        raise ConfigError(f"Only {mapped} are read by a mapping: leave --mapping out: {paths[0]}")
    with tempfile.TemporaryDirectory(prefix="demorec-reading-", ignore_cleanup_errors=True) as folder:
        _check_space([path for path, kind in zip(paths, kinds, strict=True) if kind], Path(folder))
        found = []
        for number, (path, kind, form) in enumerate(zip(paths, kinds, forms, strict=True)):
            if kind is None:
                found.append(path)
                continue
            run = Path(folder) / str(number) / path.resolve().name
            run.parent.mkdir()
            chosen = None
            if form is None or form.mapping:
                chosen = mapping or _suggested(path, form, Path(folder) / f"{number}.toml", tell)
            if form is not None:
                for line in form.read([path], chosen, run, VideoConfig()).left_out_lines():
                    tell(line)
            elif chosen is not None:
                _import_bag(path, chosen, run, tell)
            found.append(run)
        yield found


def import_kind(path: Path, imports_datasets: bool) -> PathKind | None:
    """What a path is to be imported as; None for what is read as it is, and for what no command reads."""
    kind = find(path).kind
    return kind if kind in IMPORTED or (imports_datasets and kind == "dataset") else None


def _check_space(paths: Sequence[Path], folder: Path) -> None:
    """ConfigError unless there is room for what is read: encoded images stay as they are, pixels become smaller."""
    files = [file for path in paths for file in ([path] if path.is_file() else path.rglob("*")) if file.is_file()]
    needed, free = sum(file.stat().st_size for file in files), shutil.disk_usage(folder).free
    if needed > free:
        raise ConfigError(
            f"Reading this takes up to {needed / _MB:,.0f} MB in {folder.parent}, where {free / _MB:,.0f} MB are free: "
            f"set TMPDIR to a folder on a larger disk: {paths[0]}"
        )


def _suggested(path: Path, form: SourceFormat | None, target: Path, tell: Callable[[str], None]) -> Path:
    """The mapping that --suggest writes of a format, or of bags, where it can be used as it is.

    Raises:
        ConfigError: It leaves something to the user.
    """
    from demorec.sources.bag import bags_in
    from demorec.sources.mapping_file import read_mapping
    from demorec.sources.suggest import suggested_mapping

    doubts: list[str] = []
    lines = form.suggest(path) if form else suggested_mapping(bags_in(path)[0], doubts.append)
    target.write_text("\n".join(lines) + "\n", encoding="utf-8")
    suggest = f"demorec import {f'{IMPORT_WORDS[form.kind]} ' if form else ''}{path} --suggest > mapping.toml"
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
    from demorec.sources.bag_files import BagError
    from demorec.sources.import_file import dropped_lines
    from demorec.sources.import_run import import_bags

    result = import_bags([path], mapping, run)
    for report in result.reports:
        for line in dropped_lines(report):
            tell(f"{report.name}: {line}")
    if not any(row.episode_index is not None for report in result.reports for row in report.episodes):
        raise BagError(f"The mapping makes no episode of this, so there is nothing to read: {path}")
