"""`demorec dataset diff`: the differences between two datasets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from demorec.cli.shared.flags import Positional, arg
from demorec.cli.shared.output import ProgressBar, counted, say, say_json
from demorec.core.errors import ConfigError, ExportError
from demorec.extensions.editing.commands.edit import MAX_SHOWN, dataset_at


@dataclass(frozen=True, kw_only=True)
class Diff:
    """Compare features, rows and encoded images of two datasets, in any order of their episodes.

    Exit code 0: no difference, 1: some, 2: unreadable.

    Examples:
      demorec dataset diff cups sorted
      demorec dataset diff cups sorted --json
    """

    a: Annotated[Positional[Path], arg(metavar="A", help="A dataset, or a run that has one.")]
    b: Annotated[Positional[Path], arg(metavar="B", help="Another dataset, or a run that has one.")]
    json: bool = False
    """Print all differences as JSON."""

    def run(self) -> int:
        """Compare and print the differences."""
        from demorec.datasets.lerobot.files import leave_pandas_out
        from demorec.extensions.editing.diff import diff

        leave_pandas_out()
        a, b = dataset_at(self.a), dataset_at(self.b)
        try:
            with ProgressBar("reading") as bar:
                found = diff(a, b, progress=bar.set)
        except ExportError as error:  # its exit code would mean that the datasets differ
            raise ConfigError(str(error)) from error
        count = len(found.differences)
        if self.json:
            say_json(found.to_json())
            return int(count > 0)
        lines = list(found.lines())
        say(*lines[:MAX_SHOWN])
        if count > MAX_SHOWN:
            say(f"{count - MAX_SHOWN} more (--json)")
        say(*found.notes)
        episodes = f"{found.num_same} of {found.num_episodes[0]} and {found.num_episodes[1]} episodes are the same"
        say(f"{counted(count, 'difference') if count else 'No difference'}: {episodes}.")
        return int(count > 0)
