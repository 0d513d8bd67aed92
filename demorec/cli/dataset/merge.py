"""`demorec dataset merge`: several datasets in one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from demorec.cli.dataset.edit import Edit, dataset_at
from demorec.cli.shared.output import say
from demorec.core.errors import ConfigError

if TYPE_CHECKING:
    from demorec.datasets.editing.plan import Plan
    from demorec.datasets.lerobot.folder import LeRobotFolder


@dataclass(frozen=True, kw_only=True)
class Merge(Edit):
    """Merge datasets; features are matched by name, and all differences are reported at once.

    Where datasets differ, a mapping is printed that joins what can be joined: check its lines, save them, and give
    them with --mapping.

    Examples:
      demorec dataset merge monday tuesday --out both
      demorec dataset merge monday tuesday --out both > mapping.toml
      demorec dataset merge monday tuesday --mapping mapping.toml --out both
    """

    datasets: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="DATASET", help="Datasets, or runs that have one; two or more.")
    ]
    mapping: Path | None = None
    """Mapping file (TOML) for datasets that differ."""

    def sources(self) -> Sequence[LeRobotFolder]:
        """The datasets in their order."""
        from demorec.datasets.lerobot.folder import LeRobotFolder

        return [LeRobotFolder(dataset_at(path)) for path in self.datasets]

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes, dataset after dataset."""
        from demorec.datasets.editing.merge import DatasetsDifferError, merge

        try:
            return merge(sources, self.mapping)
        except DatasetsDifferError as error:
            if not error.mapping:
                raise
            say(*error.mapping)
            raise ConfigError(
                f"{error} A mapping could be the lines above: look at each, save them (> FILE) and give --mapping FILE."
            ) from error
