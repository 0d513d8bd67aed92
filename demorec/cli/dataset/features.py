"""`demorec dataset rename`, `demorec dataset drop-features`: other names, fewer features."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from demorec.cli.dataset.edit import EditOne, pairs

if TYPE_CHECKING:
    from demorec.datasets.editing.plan import Plan
    from demorec.datasets.lerobot.folder import LeRobotFolder


@dataclass(frozen=True, kw_only=True)
class Rename(EditOne):
    """Rename features.

    Examples:
      demorec dataset rename cups observation.image=observation.images.top --out new
      demorec dataset rename cups state=observation.state actions=action --out new
    """

    names: Annotated[Positional[tuple[str, ...]], arg(metavar="OLD=NEW", help="Old and new name of each feature.")]

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes with features under other names."""
        from demorec.datasets.editing.operations import rename

        return rename(sources[0], pairs(self.names, "rename DATASET OLD=NEW"))


@dataclass(frozen=True, kw_only=True)
class DropFeatures(EditOne):
    """Leave out features.

    Examples:
      demorec dataset drop-features cups observation.images.side --out new
    """

    names: Annotated[Positional[tuple[str, ...]], arg(metavar="NAME", help="Features to leave out.")]

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes without these features."""
        from demorec.datasets.editing.operations import drop_features

        return drop_features(sources[0], self.names)
