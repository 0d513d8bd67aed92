"""Third-party formats, which commands read through a temporary import.

Each is a row `readers` of an extension (`demorec.core.extension`). Every command reads them by the same mapping as
`demorec import` and prints the same messages.
"""

from __future__ import annotations

import pkgutil
import shlex
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from demorec.core.errors import ConfigError, DemorecError
from demorec.core.extension import ReaderRow, kind_rows, reader_rows
from demorec.runs.find import PathKind, find

Tell = Callable[[str], None]


class ImportResult(Protocol):
    """Result of an import."""

    @property
    def num_episodes(self) -> int:
        """Number of episodes in the run."""

    def left_out_lines(self) -> Iterator[str]:
        """Describe the data left out of the run."""


def imported_kinds() -> tuple[PathKind, ...]:
    """Kinds of paths that are read only through an import; others, such as datasets, are imported for an export."""
    return tuple(kind for kind in reader_rows() if kind not in kind_rows())


def dropped_by_import(run: Path) -> list[dict[str, str]]:
    """Data that an import left out of a run, each as "bag", "what" and "reason"."""
    hooks = [row.dropped for row in reader_rows().values() if row.dropped]
    return [row for hook in hooks for row in pkgutil.resolve_name(hook)(run)]


@contextmanager
def opened(paths: Sequence[Path], mapping: Path | None, *, imports_datasets: bool, tell: Tell) -> Iterator[list[Path]]:
    """Yield a run of episodes for each path, or the path itself if it can be read directly.

    The runs are temporary and removed when the context ends, with or without an error.

    Args:
        paths: Recordings, runs, folders of recordings, and anything that can be imported.
        mapping: Mapping for the bags and files that need one; None to use the suggested mapping if it is complete.
        imports_datasets: Whether datasets are opened as recordings.
        tell: Called with one line for each part left out and each mapping used.

    Raises:
        ConfigError: A mapping is missing, impossible or given without need.
        DemorecError: As in the importers.
    """
    by_kind = reader_rows()
    kinds = [import_kind(path, imports_datasets) for path in paths]
    forms = {path: by_kind[kind] for path, kind in zip(paths, kinds, strict=True) if kind is not None}
    if mapping is not None and not any(form.suggester for form in forms.values()):
        mapped = " and ".join(form.plural for form in by_kind.values() if form.suggester)
        raise ConfigError(f"Only {mapped} are read by a mapping: leave --mapping out: {paths[0]}")
    with tempfile.TemporaryDirectory(prefix="demorec-reading-", ignore_cleanup_errors=True) as folder:
        found = []
        for number, path in enumerate(paths):
            if path not in forms:
                found.append(path)
                continue
            run = Path(folder) / str(number) / path.resolve().name
            run.parent.mkdir()
            found.append(_imported(path, forms[path], mapping, run, tell))
        yield found


def _imported(path: Path, form: ReaderRow, mapping: Path | None, run: Path, tell: Tell) -> Path:
    """Import a path and return its run."""
    if not form.suggester:
        mapping = None
    elif mapping is None:
        mapping = _suggested(path, form, run.with_suffix(".toml"), tell)
    result: ImportResult = pkgutil.resolve_name(form.importer)(form.files([path]), mapping, run)
    for line in result.left_out_lines():
        tell(line)
    if not result.num_episodes:
        raise DemorecError(f"The mapping yields no episode, so nothing can be read: {path}")
    return run


def import_kind(path: Path, imports_datasets: bool) -> PathKind | None:
    """Return the kind under which a path is imported; None if it is read directly, or by no command."""
    kind = find(path).kind
    return kind if kind in imported_kinds() or (imports_datasets and kind in reader_rows()) else None


def _suggested(path: Path, form: ReaderRow, target: Path, tell: Tell) -> Path:
    """Write the suggested mapping; ConfigError if it leaves a decision to the user."""
    doubts: list[str] = []
    target.write_text("\n".join(pkgutil.resolve_name(form.suggester)(path, doubts.append)) + "\n", encoding="utf-8")
    suggest = f"{form.command} {shlex.quote(str(path))} --suggest > mapping.toml"
    if doubts:
        raise ConfigError(
            f"This is read by a mapping (--mapping FILE), and the suggested one leaves a decision to you: "
            f"{doubts[0].removesuffix('.')}; {suggest} writes it: {path}"
        )
    tell(f"{path}: read by the suggested mapping; {suggest} writes it, --mapping takes another.")
    return target
