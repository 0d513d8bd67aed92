"""Flags `--robot.NAME=...` of the simulated arms."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from lerobot.robots import RobotConfig


@dataclass(kw_only=True)
class SimulatedArmConfig(RobotConfig):  # type: ignore[misc]
    """Scene of a task and its cameras; names as in `generate-dataset`."""

    task: str = "pick_place"
    scene: int = 0
    seed: int = 0
    variation: str = "mild"
    cameras: list[str] = field(default_factory=lambda: ["front", "wrist"])
    width: int = 640
    height: int = 480
    fps: int = 30
    record: Path | None = None

    def __post_init__(self) -> None:
        """Skip LeRobot's own method, which expects camera hardware instead of names."""


@RobotConfig.register_subclass("demorec_so101")
@dataclass(kw_only=True)
class DemorecSO101Config(SimulatedArmConfig):
    """The SO-101, like LeRobot's own `so101_follower`."""

    use_degrees: bool = True


@RobotConfig.register_subclass("demorec_panda")
@dataclass(kw_only=True)
class DemorecPandaConfig(SimulatedArmConfig):
    """The Panda."""
