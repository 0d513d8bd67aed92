"""`demorec dataset reorder`, `demorec dataset shuffle`: the episodes in another order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from demorec.cli.dataset.edit import EditOne, episode_numbers

if TYPE_CHECKING:
    from demorec.datasets.editing.plan import Plan
    from demorec.datasets.lerobot.folder import LeRobotFolder


@dataclass(frozen=True, kw_only=True)
class Reorder(EditOne):
    """Put the episodes into another order: sorted by a column, or as listed.

    Examples:
      demorec dataset reorder cups --by num_frames --out sorted
      demorec dataset reorder cups --order 2,0,1 --out new
    """

    by: str = ""
    """Column to sort by."""
    descending: bool = False
    """With --by: largest first."""
    order: tuple[str, ...] = ()
    """Numbers of all episodes in their new order, 2,0,1."""
    scores: Path | None = None
    """With --by score: file of demorec dataset score --out (auto: the dataset is scored)."""

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes in the new order."""
        from demorec.cli.dataset.score import scored_columns
        from demorec.datasets.editing.operations import reorder

        rows = scored_columns(sources[0], {self.by}, self.scores) if self.by else ()
        return reorder(sources[0], rows, self.by, episode_numbers(self.order), descending=self.descending)


@dataclass(frozen=True, kw_only=True)
class Shuffle(EditOne):
    """Put the episodes into a random order.

    Examples:
      demorec dataset shuffle cups --seed 7 --out shuffled
    """

    seed: int = 0
    """Seed of the order."""

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes in an order that the seed decides."""
        from demorec.datasets.editing.operations import shuffle

        return shuffle(sources[0], self.seed)
