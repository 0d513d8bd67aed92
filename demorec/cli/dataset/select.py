"""`demorec dataset select`, `demorec dataset drop`: some episodes, or all others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from demorec.cli.dataset.edit import CONDITION_HELP, EditOne, episode_numbers
from demorec.core.errors import ConfigError

if TYPE_CHECKING:
    from demorec.datasets.editing.plan import Plan
    from demorec.datasets.lerobot.folder import LeRobotFolder


@dataclass(frozen=True, kw_only=True)
class Chosen(EditOne):
    """Flags that choose episodes."""

    where: Annotated[str, arg(help=CONDITION_HELP)] = ""
    episodes: tuple[str, ...] = ()
    """Numbers of episodes, 0,3,5:9."""
    scores: Path | None = None
    """File of demorec dataset score --out, for conditions on the score (auto: the dataset is scored)."""

    def chosen(self, source: LeRobotFolder) -> list[int]:
        """Numbers of the chosen episodes."""
        from demorec.cli.dataset.score import scored_columns
        from demorec.datasets.editing.operations import chosen, names_in

        rows = scored_columns(source, names_in(self.where), self.scores)
        return chosen(source, rows, self.where, episode_numbers(self.episodes) if self.episodes else None)


@dataclass(frozen=True, kw_only=True)
class Select(Chosen):
    """Keep the episodes that are named or for which a condition holds.

    Examples:
      demorec dataset select cups --where 'success and num_frames < 300' --out good
      demorec dataset select cups --where 'score > 0.8' --out good
      demorec dataset select cups --episodes 0:50 --out first
    """

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """The chosen episodes."""
        return self._select(sources[0], drop=False)

    def _select(self, source: LeRobotFolder, *, drop: bool) -> Plan:
        from demorec.datasets.editing.operations import select

        if not self.where and not self.episodes:
            raise ConfigError(f"Choose the episodes to {'drop' if drop else 'keep'}: --where or --episodes.")
        return select(source, self.chosen(source), drop=drop)


@dataclass(frozen=True, kw_only=True)
class Drop(Select):
    """Leave out the episodes that are named or for which a condition holds.

    Examples:
      demorec dataset drop cups --episodes 3,7,20:25 --out rest
      demorec dataset drop cups --where 'not success' --out successes
    """

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes but the chosen ones."""
        return self._select(sources[0], drop=True)
