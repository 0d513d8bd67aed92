"""A policy that needs neither LeRobot nor PyTorch, for workers of `demorec evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.config import EpisodePlan
from demorec.extensions.policies import rollouts
from demorec.runs.run_file import Attempt


class Lazy:
    def __init__(self, *_: object, **__: object) -> None:
        pass

    def reset(self, seed: int) -> None:
        pass

    def act(self, observation: dict[str, Any], instruction: str) -> Any:
        return np.array(observation["agent_pos"], dtype=np.float64)


def make_rollout(plan: EpisodePlan, folder: Path) -> Attempt:
    """Make a rollout as a worker does, with this policy."""
    setattr(rollouts, "Policy", Lazy)  # noqa: B010
    return rollouts.make_rollout(plan, folder)
