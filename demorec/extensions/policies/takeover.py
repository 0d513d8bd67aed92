"""When the expert takes over from a policy."""

from __future__ import annotations

from dataclasses import dataclass

from demorec.core.errors import check_option
from demorec.core.options import Rare


@dataclass(frozen=True, kw_only=True)
class TakeOver:
    """Conditions of a takeover by the expert: at the first that holds, and always at the time limit."""

    stuck_seconds: float = 2.0
    """Take over once the hand has kept still this long; 0: never."""
    stray_metres: float = 0.05
    """Take over once the TCP that the policy commands is this far from the expert's path in the same scene, or an
    object this far from its place under the expert; 0: never.
    """
    stray_radians: Rare[float] = 0.5
    """Take over once the hand's direction differs this much from the expert's; 0: never."""
    noise: bool = True
    """Add the exploration noise of demonstrations to the expert's commands; labels stay clean."""

    def validate(self) -> None:
        """Raise OptionError for impossible values."""
        check_option("stuck_seconds", self.stuck_seconds, 0.0, 600.0, "s")
        check_option("stray_metres", self.stray_metres, 0.0, 2.0, "m")
        check_option("stray_radians", self.stray_radians, 0.0, 3.2, "rad")
