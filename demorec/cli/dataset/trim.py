"""`demorec dataset trim`: episodes without their first and last frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from demorec.cli.dataset.edit import EditOne
from demorec.core.errors import ConfigError

if TYPE_CHECKING:
    from demorec.datasets.editing.plan import Plan
    from demorec.datasets.lerobot.folder import LeRobotFolder


@dataclass(frozen=True, kw_only=True)
class Trim(EditOne):
    """Cut frames off the beginning and the end of each episode.

    Examples:
      demorec dataset trim cups --idle --out moving
      demorec dataset trim cups --head 10 --tail 5 --out shorter
    """

    head: int = 0
    """Frames to cut off at the beginning of each episode."""
    tail: int = 0
    """Frames to cut off at the end."""
    idle: bool = False
    """Cut off the frames before the first and after the last motion."""
    idle_feature: str | None = None
    """With --idle: feature whose changes count as motion (auto: the state)."""
    idle_threshold: float = 0.01
    """With --idle: motion is a change by more than this share of the feature's range."""
    idle_margin: int = 3
    """With --idle: still frames to keep at either end."""

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes, trimmed."""
        from demorec.datasets.editing import operations

        if self.idle == bool(self.head or self.tail):
            raise ConfigError("Give either --idle, or frames by --head and --tail.")
        if self.idle:
            features = self._state(sources[0]) if self.idle_feature is None else (self.idle_feature,)
            return operations.trim_idle(sources[0], features, self.idle_threshold, self.idle_margin)
        return operations.trim(sources[0], self.head, self.tail)

    def _state(self, source: LeRobotFolder) -> tuple[str, ...]:
        """The features that are the state; ConfigError if none is found."""
        found = source.roles.state
        if not found:
            raise ConfigError(f"No state was found: name a feature by --idle-feature: {source.root}")
        return found
