"""Does the data teach? A policy in closed loop over held-out scenes, with how sure its success rate is."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from demorec.core.errors import check_option


@dataclass(frozen=True, kw_only=True)
class TakeOver:
    """When the expert takes over: at the first of these moments, and at the time limit always."""

    stuck_seconds: float = 2.0
    """Take over once the hand has kept still this long; 0: never."""
    after_seconds: float = 0.0
    """Take over once the policy has acted this long without success; 0: only at the time limit."""
    random_share: float = 0.0
    """Share of the episodes in which the expert takes over at a random moment, whatever the policy does."""
    stray_metres: float = 0.05
    """Take over once the TCP that the policy commands is this far from the expert's path in the same scene, or an
    object this far from where the expert would have it; 0: never."""
    stray_radians: float = 0.5
    """The same for the hand's direction; 0: never."""
    stray_seconds: float = 0.2
    """How long the TCP must be that far off without a break."""
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


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What decides the result of improving a policy in rounds, besides demonstrations and flags of lerobot-train."""

    config_path: Path
    """Settings for lerobot-train (JSON); its dataset, output folder and seed are replaced."""
    num_rounds: int = 2
    """Number of rounds of corrections."""
    num_episodes: int = 50
    """Scenes per round in which the policy is corrected."""
    num_scenes: int = 50
    """Held-out scenes on which each policy is evaluated."""
    seed: int = 1
    """Seed of the trainings; the scenes of round k use the root seed of the demonstrations plus SEED + k."""
    action: str = "joint_increment"
    """joint, joint_increment, ee or ee_delta."""
    state: str = "joint"
    """joint or joint_ee, as in demorec export lerobot."""
    privileged: bool = False
    """As in demorec export lerobot: let the policy see observation.environment_state."""
    features: tuple[str, ...] = ()
    """As in demorec export lerobot: the features to learn from; all by default."""
    takeover: TakeOver = field(default_factory=TakeOver)
    """When the expert takes over."""

    def validate(self) -> None:
        """Raise OptionError for impossible values."""
        check_option("num_rounds", self.num_rounds, 0, 1000)
        check_option("num_episodes", self.num_episodes, 1, 1_000_000)
        check_option("num_scenes", self.num_scenes, 1, 1_000_000)
        self.takeover.validate()
