"""How far a rollout came: in which phase of the work it went wrong."""

from __future__ import annotations

import math

from demorec.episode.scene import Goal, Scene
from demorec.gym_env import Situation
from demorec.sim.world import World
from demorec.tasks.success import goal_pose

PHASES = ("reach", "lift", "transport", "place")
"""reach: nothing was grasped; lift: grasped, never lifted; transport: lifted, never brought near its goal; place:
brought there, but the conditions did not hold in the end."""

GRASP_FORCE = 0.5
LIFTED = 0.03
NEAR_GOAL = 0.05


class EvaluationObserver:
    """Watches the rollout of one episode; with several goals, the least advanced object counts."""

    def __init__(self, scene: Scene) -> None:
        self._goals = scene.goals
        self._start = {goal.object: scene.body(goal.object).world_from_body.position[2] for goal in scene.goals}
        self._stage = [0] * len(scene.goals)

    def watch(self, world: World) -> None:
        """Take note of the present state."""
        for number, goal in enumerate(self._goals):
            self._stage[number] = max(self._stage[number], self._reached(world, goal, self._stage[number]))

    def _reached(self, world: World, goal: Goal, stage: int) -> int:
        held = world.grip_force(goal.object) > GRASP_FORCE
        position = world.pose(goal.object).position
        if stage == 0:
            return 1 if held else 0
        lifted = held and position[2] - self._start[goal.object] > LIFTED
        if stage == 1:
            return 2 if lifted else 1
        near = math.dist(position[:2], goal_pose(world, goal).position[:2]) < NEAR_GOAL
        return 3 if near else 2

    def failure(self, situation: Situation) -> tuple[str, str]:
        """Phase and reason of a failure: the name of the first condition that does not hold, or "time_limit"."""
        reason = next((check.name for check in situation.checks if not check.passed), "time_limit")
        return PHASES[min(self._stage, default=0)], reason


def factors_of(scene: Scene) -> dict[str, float]:
    """What was randomised in a scene, as numbers: places, sizes, yaws and physics of the objects to be moved."""
    values: dict[str, float] = {}
    for number, goal in enumerate(scene.goals):
        prefix = "" if len(scene.goals) == 1 else f"{number}."
        body = scene.body(goal.object)
        place = body.world_from_body
        values[f"{prefix}object.x"], values[f"{prefix}object.y"] = (float(v) for v in place.position[:2])
        values[f"{prefix}object.radius"] = math.hypot(*place.position[:2].tolist())
        values[f"{prefix}object.size"] = max(body.shape.extents)
        values[f"{prefix}object.mass"] = body.mass
        values[f"{prefix}object.friction"] = body.lateral_friction
        wanted = scene.world_from_goal(goal).position
        values[f"{prefix}goal.x"], values[f"{prefix}goal.y"] = (float(v) for v in wanted[:2])
        values[f"{prefix}distance"] = math.dist(place.position[:2], wanted[:2])
    return values
