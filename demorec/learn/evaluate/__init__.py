"""Does the data teach? A policy in closed loop over held-out scenes, with how sure its success rate is."""

from __future__ import annotations

from dataclasses import dataclass

from demorec.core.errors import check_option


@dataclass(frozen=True, kw_only=True)
class TakeOver:
    """When the expert takes over: at the first of these moments, and at the time limit always."""

    stuck_seconds: float = 2.0
    """The hand has kept still for so long; 0 for never."""
    after_seconds: float = 0.0
    """The policy has acted for so long without success; 0 for the time limit alone."""
    random_share: float = 0.0
    """Share of the episodes in which the expert takes over at a random moment, whatever the policy does."""
    stray_metres: float = 0.05
    """The TCP that the policy commands is so far from the expert's path in the same scene, or an object from where
    the expert would have it; 0 for never."""
    stray_radians: float = 0.5
    """The same of the hand's direction; 0 for never."""
    stray_seconds: float = 0.2
    """How long the TCP must be so far off without a break."""
    noise: bool = True
    """Let the expert send its commands with the exploration noise of demonstrations, beside clean labels."""
    hand_back: bool = False
    """Let the policy act again once the expert has stopped the arm and brought it to where a script can begin."""

    def validate(self) -> None:
        """Raise OptionError for impossible values."""
        check_option("stuck_seconds", self.stuck_seconds, 0.0, 600.0, "s")
        check_option("after_seconds", self.after_seconds, 0.0, 3600.0, "s")
        check_option("random_share", self.random_share, 0.0, 1.0)
        check_option("stray_metres", self.stray_metres, 0.0, 2.0, "m")
        check_option("stray_radians", self.stray_radians, 0.0, 3.2, "rad")
        check_option("stray_seconds", self.stray_seconds, 0.0, 60.0, "s")
