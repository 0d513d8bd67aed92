"""Success of the expert from states that another agent has caused, by the kind of state.

    python benchmarks/recovery.py --tasks pick_place stack --states 50

script: the middle of a scripted episode, arm in motion; flailing: from there a random walk of all joints, the hand
opening and closing, for up to two seconds; moved: the object of the first goal is elsewhere on the table. Random walks
push objects out of the arm's reach and tip them over; these count as failures here.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace

import numpy as np

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.geometry import Array, Pose
from demorec.core.tables import TASKS
from demorec.episode.episode import Action
from demorec.extensions.policies.statistics import Rate
from demorec.loop import PreparedEpisode, ScriptAgent, Session, make_world, prepare
from demorec.sim.world import World
from demorec.tasks.script import ExpertFailure
from demorec.tasks.skills import Expert

KINDS = ("script", "flailing", "moved")
_FREE = 0.16
"""Minimum distance of a displaced object from all others and the hand, metres."""


def bring_about(kind: str, world: World, episode: PreparedEpisode, random: np.random.Generator) -> None:
    """Bring the world into a state."""
    frames = int(random.integers(5, 200))
    for frame in Session.of_episode(world, episode).run(ScriptAgent(episode)):
        if frame.frame_index == frames:
            break
    if kind == "flailing":
        flail(world, random)
    elif kind == "moved":
        move_object(world, random)


def flail(world: World, random: np.random.Generator) -> None:
    arm, target = world.arm.kinematics, world.arm.target.copy()
    velocity: Array = np.zeros(len(target))
    opening = world.arm.gripper_target
    for step in range(int(random.integers(10, 60))):
        if step % 15 == 0:
            opening = float(random.choice([0.0, world.robot.gripper.max_width]))
        velocity = 0.9 * velocity + random.normal(0.0, 0.012, len(target))
        target = np.clip(target + velocity, arm.lower, arm.upper)
        world.apply(Action(joint_target=target, gripper_target=opening, base_from_tcp_target=arm.forward(target)))


def move_object(world: World, random: np.random.Generator) -> None:
    body = world.body(world.scene.goals[0].object)
    others = [
        world.pose(b.name).position[:2] for b in world.scene.bodies if b.name != body.name and b.role != "support"
    ]
    others.append(world.arm.world_from_tcp().position[:2])
    places = random.uniform((0.38, -0.25), (0.62, 0.25), (200, 2))
    x, y = next(
        (place for place in places if min(np.hypot(*(place - other)) for other in others) > _FREE), places[0]
    ).tolist()
    pose = Pose.from_yaw((x, y, body.shape.extents[2] / 2 + 0.001), float(random.uniform(0, 2 * np.pi)))
    world.set_state(object_poses={body.name: pose})
    for _ in range(8):
        world.apply(world.hold())


def outcome(world: World, episode: PreparedEpisode) -> str:
    """Describe the failure at the end; "" for a success."""
    expert = Expert(world, replace(episode.behaviour, miss_x=0.0, miss_y=0.0))
    try:
        for step in episode.task.resume(expert):
            world.apply(step.action)
    except ExpertFailure as error:
        return f"{error.phase}: {error.reason}"
    return next((check.name for check in episode.task.evaluate(world) if not check.passed), "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["pick_place"], choices=TASKS.names())
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--states", type=int, default=50)
    arguments = parser.parse_args()
    for task in arguments.tasks:
        for kind in arguments.kinds:
            found: Counter[str] = Counter()
            for index in range(arguments.states):
                episode = prepare(EpisodePlan(config=GenerateConfig(task=task, cameras=()), episode_index=index))
                with make_world(episode.info) as world:
                    bring_about(kind, world, episode, np.random.default_rng([index, KINDS.index(kind)]))
                    found[outcome(world, episode)] += 1
            rate = Rate(successes=found.pop("", 0), trials=arguments.states)
            print(f"{task:<18} {kind:<9} {rate}  {dict(found)}", flush=True)


if __name__ == "__main__":
    main()
