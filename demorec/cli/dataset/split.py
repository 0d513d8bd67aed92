"""`demorec dataset split`: a dataset in parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from demorec.cli.dataset.edit import EditOne, pairs
from demorec.core.errors import ConfigError

if TYPE_CHECKING:
    from demorec.datasets.editing.plan import Plan
    from demorec.datasets.lerobot.folder import LeRobotFolder


@dataclass(frozen=True, kw_only=True)
class Split(EditOne):
    """Split a dataset into parts, each a dataset in a folder of its name within --out; all appear together.

    Examples:
      demorec dataset split cups --shares train=0.8 val=0.2 --out parts
      demorec dataset split cups --shares train=0.8 val=0.2 --by task --out parts
    """

    shares: tuple[str, ...] = ()
    """Names and shares of the parts, train=0.8 val=0.2."""
    by: str = ""
    """Column to stratify by: each of its values is divided in the same proportions."""
    seed: int = 0
    """Seed of the random parts."""
    scores: Path | None = None
    """With --by score: file of demorec dataset score --out (auto: the dataset is scored)."""

    def part_names(self) -> Sequence[str]:
        """Names of the parts."""
        return list(self._shares())

    def plans(self, sources: Sequence[LeRobotFolder]) -> Mapping[str, Plan]:
        """Name of each part -> its episodes."""
        from demorec.cli.dataset.score import scored_columns
        from demorec.datasets.editing.operations import split

        rows = scored_columns(sources[0], {self.by}, self.scores)
        return split(sources[0], rows, self._shares(), self.seed, by=self.by)

    def _shares(self) -> Mapping[str, float]:
        example = "--shares train=0.8 val=0.2"
        try:
            found = pairs(" ".join(self.shares).replace(",", " ").split(), example)
            shares = {name: float(share) for name, share in found.items()}
        except ValueError as error:
            raise ConfigError(f"A share is a number: {example}.") from error
        if wrong := [name for name in shares if Path(name).name != name or name in ("", ".", "..")]:
            raise ConfigError(f"A part cannot be called {wrong[0]!r}: its name is that of its folder.")
        return shares
