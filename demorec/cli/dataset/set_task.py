"""`demorec dataset set-task`: another instruction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from demorec.cli.dataset.select import Chosen

if TYPE_CHECKING:
    from demorec.datasets.editing.plan import Plan
    from demorec.datasets.lerobot.folder import LeRobotFolder


@dataclass(frozen=True, kw_only=True)
class SetTask(Chosen):
    """Give all episodes, or the chosen ones, another instruction.

    Examples:
      demorec dataset set-task cups --task 'pick up the cup' --out relabelled
      demorec dataset set-task cups --task 'lift it' --episodes 0:9 --out relabelled
    """

    task: str = ""
    """The new instruction."""

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes, the chosen ones with the new instruction."""
        from demorec.datasets.editing.operations import set_task

        return set_task(sources[0], self.task, self.chosen(sources[0]))
