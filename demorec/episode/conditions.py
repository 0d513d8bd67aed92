"""The conditions of success that demorec's tasks share, as plain data: tasks judge by them, and checks judge these."""

from __future__ import annotations

import math
from typing import Literal

MAX_DISTANCE = 0.02
MAX_HEIGHT_ERROR = 0.004
MAX_TILT = math.radians(5.0)
MAX_SPEED = 0.01
MAX_SPIN = 0.1
MAX_DISTURBANCE = 0.02
"""How far an object that is not to be moved may end from where it was, metres."""
MIN_OPENING = 0.875
"""Share of the gripper's full opening that counts as open."""

DISTURBED, OPEN = "disturbed", "gripper_width"
LIMITS: dict[str, tuple[Literal["at most", "at least"], float]] = {
    "distance_to_goal": ("at most", MAX_DISTANCE),
    "height_error": ("at most", MAX_HEIGHT_ERROR),
    "on_support": ("at least", 1.0),
    "on_table": ("at least", 1.0),
    "tilt": ("at most", MAX_TILT),
    "speed": ("at most", MAX_SPEED),
    "spin": ("at most", MAX_SPIN),
    "touched_by_robot": ("at most", 0.0),
    DISTURBED: ("at most", MAX_DISTURBANCE),
    OPEN: ("at least", MIN_OPENING),
}
"""Condition, without the object that it is about -> what its value has to be; of the opening, as a share."""
