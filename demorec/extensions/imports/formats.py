"""Formats that are imported, a row each; `demorec import` and commands that read foreign files go by the rows.

Other commands read through a temporary import, by the same mapping as `demorec import`, in the same words.
"""

from __future__ import annotations

import pkgutil
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

from demorec.core.errors import ConfigError, DemorecError
from demorec.core.plain import listed
from demorec.extensions.imports.mapping import SourceKind, SourceMapping
from demorec.runs.find import IMPORT_WORDS, PathKind, find

Tell = Callable[[str], None]


class ImportResult(Protocol):
    """Result of an import."""

    @property
    def num_episodes(self) -> int:
        """Number of episodes in the run."""

    def left_out_lines(self) -> Iterator[str]:
        """Describe what the run does not have."""


@dataclass(frozen=True, kw_only=True)
class SourceFormat:
    """Format of files or folders of other programs.

    Attributes:
        kind: Kind of path, as `demorec.runs.find` knows it.
        name: Plural, for a sentence.
        example: Example of what follows `demorec import` and the format's word.
        importer: "module:function" of (paths, mapping, out), which makes or continues the run `out`.
        mapping: Kind of its mappings; None if it needs none.
        suggester: "module:function" of (path, tell): the lines of a mapping; `tell` is called with what it leaves to
            the user.
    """

    kind: PathKind
    name: str
    example: str
    importer: str
    mapping: SourceKind | None = None
    suggester: str = ""

    @property
    def command(self) -> str:
        """The command that imports it, without paths."""
        return " ".join(filter(None, ("demorec import", IMPORT_WORDS.get(self.kind))))

    def read(self, paths: Sequence[Path], mapping: Path | None, out: Path, **options: Any) -> ImportResult:
        """Make or continue the run `out`; options, result and errors are those of the importer."""
        return cast(ImportResult, pkgutil.resolve_name(self.importer)(paths, mapping, out, **options))

    def suggest(self, path: Path, tell: Tell) -> list[str]:
        """Return the lines of a mapping."""
        return cast(list[str], pkgutil.resolve_name(self.suggester)(path, tell))


BAGS = SourceFormat(
    kind="rosbag",
    name="bags",
    example="monday.mcap --mapping robot.toml --out runs/robot",
    importer="demorec.extensions.imports.import_run:import_bags",
    mapping="bag",
    suggester="demorec.extensions.imports.suggest:suggested_mapping",
)
_ROWS = (
    BAGS,
    SourceFormat(
        kind="dataset",
        name="LeRobot datasets",
        example="datasets/cups --out runs/cups",
        importer="demorec.extensions.imports.dataset_import:import_lerobot",
    ),
    SourceFormat(
        kind="hdf5",
        name="HDF5 files",
        example="demo.hdf5 --mapping mapping.toml --out runs/demo",
        importer="demorec.extensions.imports.hdf5_import:import_hdf5",
        mapping="hdf5",
        suggester="demorec.extensions.imports.hdf5_suggest:suggested_hdf5_mapping",
    ),
)
FORMATS: Mapping[str, SourceFormat] = {IMPORT_WORDS[form.kind]: form for form in _ROWS if form.kind in IMPORT_WORDS}
"""The first word after `demorec import` -> the format; bags need none."""
IMPORTED: tuple[PathKind, ...] = tuple(form.kind for form in _ROWS if form.mapping)
"""Kinds of paths that no command reads as they are. Datasets are, but where recordings are needed (export)."""
_MB = 1e6
_MOST_SHOWN = 6
"""Features and cameras of a suggested mapping that are named."""


@contextmanager
def opened(paths: Sequence[Path], mapping: Path | None, *, imports_datasets: bool, tell: Tell) -> Iterator[list[Path]]:
    """Give for each path a run of its episodes, or the path itself where that is read as it is.

    The runs are temporary: they are removed when the context ends, however it ends.

    Args:
        paths: Recordings, runs, folders of recordings, and whatever can be imported.
        mapping: Of the bags and files that need one; None where the one that `demorec import --suggest` writes leaves
            nothing to decide.
        imports_datasets: Whether datasets are opened as recordings.
        tell: Called with what was left out, and by which mapping, a line each.

    Raises:
        ConfigError: A mapping is missing, given for what needs none, or impossible; or the disk is too small.
        DemorecError: As of the importers.
    """
    by_kind = {form.kind: form for form in _ROWS}
    kinds = [import_kind(path, imports_datasets) for path in paths]
    forms = {path: by_kind[kind] for path, kind in zip(paths, kinds, strict=True) if kind is not None}
    if mapping is not None and not any(form.mapping for form in forms.values()):
        mapped = " and ".join(form.name for form in _ROWS if form.mapping)
        raise ConfigError(f"Only {mapped} are read by a mapping: leave --mapping out: {paths[0]}")
    with tempfile.TemporaryDirectory(prefix="demorec-reading-", ignore_cleanup_errors=True) as folder:
        _check_space([*forms], Path(folder))
        found = []
        for number, path in enumerate(paths):
            if path not in forms:
                found.append(path)
                continue
            run = Path(folder) / str(number) / path.resolve().name
            run.parent.mkdir()
            found.append(_imported(path, forms[path], mapping, run, tell))
        yield found


def _imported(path: Path, form: SourceFormat, mapping: Path | None, run: Path, tell: Tell) -> Path:
    """Import a path and return its run."""
    if form.mapping is None:
        mapping = None
    elif mapping is None:
        mapping = _suggested(path, form, run.with_suffix(".toml"), tell)
    result = form.read([path], mapping, run)
    for line in result.left_out_lines():
        tell(line)
    if not result.num_episodes:
        raise DemorecError(f"The mapping makes no episode of this, so there is nothing to read: {path}")
    return run


def import_kind(path: Path, imports_datasets: bool) -> PathKind | None:
    """Return the kind that a path is to be imported as; None for what is read as it is, or by no command."""
    kind = find(path).kind
    return kind if kind in IMPORTED or (imports_datasets and kind == "dataset") else None


def _check_space(paths: Sequence[Path], folder: Path) -> None:
    """Raise ConfigError unless there is room: encoded images stay as they are, pixels become smaller."""
    files = [file for path in paths for file in ([path] if path.is_file() else path.rglob("*")) if file.is_file()]
    needed, free = sum(file.stat().st_size for file in files), shutil.disk_usage(folder).free
    if needed > free:
        raise ConfigError(
            f"Reading this takes up to {needed / _MB:,.0f} MB in {folder.parent}, where {free / _MB:,.0f} MB are free: "
            f"set TMPDIR to a folder on a larger disk: {paths[0]}"
        )


def _suggested(path: Path, form: SourceFormat, target: Path, tell: Tell) -> Path:
    """Write the mapping that --suggest writes; ConfigError if it leaves something to the user."""
    from demorec.extensions.imports.mapping_file import read_mapping

    doubts: list[str] = []
    target.write_text("\n".join(form.suggest(path, doubts.append)) + "\n", encoding="utf-8")
    suggest = f"{form.command} {path} --suggest > mapping.toml"
    try:
        if doubts:
            raise ConfigError(doubts[0])
        used = read_mapping(target, form.mapping or "bag")
    except ConfigError as error:
        reason = str(error).removesuffix(f": {target}")
        raise ConfigError(
            f"This is read by a mapping (--mapping FILE), and the suggested one leaves something to you: {reason}; "
            f"{suggest} writes it: {path}"
        ) from error
    tell(f"{path}: read by the suggested mapping ({_taken(used)}); {suggest} writes it, --mapping takes another.")
    return target


def _taken(mapping: SourceMapping) -> str:
    """Describe what a mapping takes, in a line."""
    parts = [
        f"{name} from {' and '.join(dict.fromkeys(source.place for source in of))}"
        for name, of in mapping.features.items()
    ]
    return listed([*parts, *(f"camera {name}" for name in mapping.cameras)], _MOST_SHOWN, ", ")
