"""At which moments the expert takes over from a policy."""

from __future__ import annotations

from dataclasses import dataclass

from demorec.errors import check_option


@dataclass(frozen=True, kw_only=True)
class TakeOver:
    """When the expert takes over: at the first of these moments, and at the time limit always."""

    stuck_seconds: float = 2.0
    """The hand has kept still for so long; 0 for never."""
    after_seconds: float = 0.0
    """The policy has acted for so long without success; 0 for the time limit alone."""
    random_share: float = 0.0
    """Share of the episodes in which the expert takes over at a random moment, whatever the policy does."""

    def validate(self) -> None:
        """Raise OptionError for impossible values."""
        check_option("stuck_seconds", self.stuck_seconds, 0.0, 600.0, "s")
        check_option("after_seconds", self.after_seconds, 0.0, 3600.0, "s")
        check_option("random_share", self.random_share, 0.0, 1.0)
