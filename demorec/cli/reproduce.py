"""`demorec reproduce`: the same data again, from what a run or a dataset says about itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from demorec.cli.shared.allow import Allow, allowed_modules
from demorec.cli.shared.output import say, tell
from demorec.cli.shared.paths import refuse_inside


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Make a run or a dataset again and compare every episode to the bit.

    Config and seed are read from run.json, or from what a dataset says about itself; compared is what the recordings,
    or the dataset's tables and videos, hold now. Exit code 1 when an episode differs or cannot be read. The same
    command again goes on where it stopped.

    Examples:
      demorec reproduce recordings/cubes --out /tmp/cubes
      demorec reproduce datasets/cubes --out /tmp/cubes --workers 8
    """

    source: Positional[Path]
    """A run, or a dataset that was exported from one."""
    out: Path
    """Folder of the new run."""
    workers: int | None = None
    """Processes that simulate (auto: one for each core)."""
    executor: Literal["local", "ray"] = "local"
    """Processes of this machine, or tasks of a Ray cluster."""
    address: str = "local"
    """Ray: the cluster, for example auto or HOST:6379; local: this machine alone."""
    allow: Allow = ()
    """A module or package of your own that may be imported for the tasks, robots and cameras that the source names."""

    def run(self) -> int:
        """Generate again, compare, report."""
        from demorec.cli.shared.progress import RunProgress
        from demorec.generate.options import RunOptions
        from demorec.generate.reproduce import Reproduction, reproduce

        options = RunOptions(
            out=self.out, workers=self.workers, executor=self.executor, address=self.address, export=False
        )
        options.validate()
        refuse_inside([self.out])
        with RunProgress() as progress:
            found = reproduce(self.source, options, progress=progress, allowed=allowed_modules(self.allow))
        if not isinstance(found, Reproduction):
            tell(f"Interrupted; the same command goes on: {self.out}")
            return 130
        total = len(found.same) + len(found.different)
        say(f"{len(found.same)} of {total} episodes are the same to the bit: {self.source} and {found.result.folder}")
        before = total - len(found.result.made)
        if before > 0:
            tell(
                f"Note: {before} of them were in {self.out} before and were not made now: a new --out proves them, too."
            )
        tell(*found.faults[:10])
        if found.different:
            shown = ", ".join(f"{episode} (attempt {attempt})" for episode, attempt in found.different[:10])
            tell(f"Different: {shown}{', ...' if len(found.different) > 10 else ''}")
            return 1
        return 0
