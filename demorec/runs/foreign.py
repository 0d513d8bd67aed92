"""Formats of other programs, which commands read through a temporary import.

Each is a row `readers` of an extension (`demorec.core.extensions`). Every command reads them by the same mapping as
`demorec import`, in the same words.
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
from demorec.core.extensions import reader_rows
from demorec.runs.find import PathKind, find

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
        example: Example of what follows `demorec import` and the format's word.
        importer: "module:function" of (paths, mapping, out), which makes or continues the run `out`.
        suggester: "module:function" of (path, tell): the lines of a mapping; `tell` is called with what it leaves to
            the user. "" for a format that needs no mapping.
        reviewer: "module:function" of a mapping's path: its features and cameras in words; ConfigError if it leaves
            something to the user. Needed with a `suggester`.
        describer: "module:function" of a path: yields (plain data, lines) for `demorec info`, without a mapping; ""
            where `info` reads it through an import.
        dropped: "module:function" of an imported run: what it left out, as rows of "bag", "what" and "reason".
    """

    kind: PathKind
    example: str
    importer: str
    suggester: str = ""
    reviewer: str = ""
    describer: str = ""
    dropped: str = ""

    @property
    def plural(self) -> str:
        """Name of several of them in a sentence."""
        return reader_rows()[self.kind].plural

    @property
    def command(self) -> str:
        """The command that imports it, without paths."""
        return " ".join(filter(None, ("demorec import", reader_rows()[self.kind].word)))

    def read(self, paths: Sequence[Path], mapping: Path | None, out: Path, **options: Any) -> ImportResult:
        """Make or continue the run `out`; options, result and errors are those of the importer."""
        return cast(ImportResult, pkgutil.resolve_name(self.importer)(paths, mapping, out, **options))

    def suggest(self, path: Path, tell: Tell) -> list[str]:
        """Return the lines of a mapping."""
        return cast(list[str], pkgutil.resolve_name(self.suggester)(path, tell))


_MB = 1e6


def formats() -> Mapping[str, SourceFormat]:
    """Kind of path -> its format."""
    return {kind: cast(SourceFormat, pkgutil.resolve_name(row.target)) for kind, row in reader_rows().items()}


def imported_kinds() -> tuple[PathKind, ...]:
    """Kinds of paths that are read through an import only; datasets are read as they are except for an export."""
    return tuple(kind for kind in reader_rows() if kind != "dataset")


def dropped_by_import(run: Path) -> list[dict[str, str]]:
    """What an import left out of a run, each as "bag", "what" and "reason"."""
    hooks = [form.dropped for form in formats().values() if form.dropped]
    return [row for hook in hooks for row in pkgutil.resolve_name(hook)(run)]


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
    by_kind = formats()
    kinds = [import_kind(path, imports_datasets) for path in paths]
    forms = {path: by_kind[kind] for path, kind in zip(paths, kinds, strict=True) if kind is not None}
    if mapping is not None and not any(form.suggester for form in forms.values()):
        mapped = " and ".join(form.plural for form in by_kind.values() if form.suggester)
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
    if not form.suggester:
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
    return kind if kind in imported_kinds() or (imports_datasets and kind == "dataset") else None


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
    doubts: list[str] = []
    target.write_text("\n".join(form.suggest(path, doubts.append)) + "\n", encoding="utf-8")
    suggest = f"{form.command} {path} --suggest > mapping.toml"
    try:
        if doubts:
            raise ConfigError(doubts[0])
        taken = pkgutil.resolve_name(form.reviewer)(target)
    except ConfigError as error:
        reason = str(error).removesuffix(f": {target}")
        raise ConfigError(
            f"This is read by a mapping (--mapping FILE), and the suggested one leaves something to you: {reason}; "
            f"{suggest} writes it: {path}"
        ) from error
    tell(f"{path}: read by the suggested mapping ({taken}); {suggest} writes it, --mapping takes another.")
    return target
