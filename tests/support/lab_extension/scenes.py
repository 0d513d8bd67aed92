"""A task, a robot and a camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from demorec.api import PANDA, CameraPreset, PickPlace, Scene

LAB_PANDA = replace(PANDA, name="lab_panda")
CORNER = CameraPreset(summary="from the corner of our table", eye=(1.2, 0.6, 0.8), target=(0.45, 0.0, 0.1))


class LabPick(PickPlace):
    """Pick a cube and place it, in the words of our lab."""

    summary = "our lab's first task"

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """Describe the task in our words."""
        del scene, rng
        return "tidy up our table"
