"""Contracts of every task and every robot, as pytest tests. Custom ones run them in three lines:

from demorec.api import RobotContract, TaskContract

class TestMyTask(TaskContract):
    task = "my_package.my_module:MyTask"

class TestMyArm(RobotContract):
    robot = "my_package.my_module:MY_ARM"
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np

from demorec.check.report import CheckOptions, Subject, check_subject, prove
from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.plain import from_json, to_json
from demorec.core.registry import modules_of
from demorec.core.tables import load_robot
from demorec.episode.episode import Frame, Outcome
from demorec.episode.info import EpisodeInfo
from demorec.episode.validity import read_episode_info
from demorec.loop import PreparedEpisode, ScriptAgent, Session, make_world, prepare
from demorec.mcap import EpisodeWriter
from demorec.robots.assets import allow_models, asset_path
from demorec.robots.model_check import spec_problems
from demorec.robots.robot import ParallelGripper, RobotSpec
from demorec.robots.urdf import Urdf, read_dynamics
from demorec.sim.arm import arm_kinematics
from demorec.tasks.grasping import hand_down, symmetric_yaws
from demorec.tasks.reach import Reach
from demorec.tasks.robot_check import finger_boxes, unreachable_poses

__all__ = ["RobotContract", "TaskContract"]


class TaskContract:
    """Layouts, instructions, success and recordings of one task with one robot, without images."""

    task: ClassVar[str]  # name of a row of `demorec list tasks`, or "package.module:Name"
    robot: ClassVar[str] = "panda"  # name of a row of `demorec list robots`, or "package.module:NAME"
    seed: ClassVar[int] = 0  # root seed of all episodes
    num_layouts: ClassVar[int] = 30  # number of layouts to draw and examine
    num_episodes: ClassVar[int] = 10  # number of episodes that the expert attempts
    min_success: ClassVar[float] = 0.9  # minimum ratio of episodes that succeed at the first attempt

    def test_scenes_and_words_follow_from_the_plan_alone(self) -> None:
        """Check that equal plans give equal descriptions, and another episode or attempt another scene."""
        infos = [self._episode(index).info for index in range(4)]
        for index, info in enumerate(infos):
            again = self._episode(index).info
            assert again == info, f"episode {index} differs when it is drawn again: is everything drawn from rng?"
        for first, second in itertools.combinations(infos, 2):
            assert first.simulated.scene != second.simulated.scene, "two episodes have the same scene"
        assert self._episode(2, attempt=1).info.simulated.scene != infos[2].simulated.scene, (
            "another attempt has the same scene"
        )

    def test_scenes_come_back_from_their_description(self) -> None:
        """Rebuild the scene from a recording's metadata; it has an instruction, and goals for movable bodies only."""
        for index, info in enumerate(self._layouts()):
            assert read_episode_info(to_json(info)) == info, f"episode {index} differs when it is read back"
            assert info.simulated.scene.goals, f"episode {index} has no goal"
            assert info.instruction.strip(), f"episode {index} has no instruction"
            assert info.instruction.isprintable(), f"the instruction of episode {index} is not one line of text"

    def test_objects_stand_apart(self) -> None:
        """Check that no two movable bodies on the table overlap."""
        for index, info in enumerate(self._layouts()):
            movable = info.simulated.scene.movable
            standing = [body for body in movable if body.world_from_body.position[2] < 0.05]
            for a, b in itertools.combinations(standing, 2):
                gap = math.dist(a.world_from_body.position[:2], b.world_from_body.position[:2])
                reach = (max(a.shape.extents[:2]) + max(b.shape.extents[:2])) / 2
                assert gap > reach, f"{a.name} and {b.name} of episode {index} are {gap:.3f} m apart"

    def test_objects_and_goals_are_within_reach(self) -> None:
        """Check that the hand, pointing down, reaches each object and its target at one yaw at least."""
        for index, info in enumerate(self._layouts()):
            scene = info.simulated.scene
            reach = Reach(scene, info.simulated.robot)
            for goal in scene.goals:
                ends = {"start": scene.body(goal.object).world_from_body, "goal": scene.world_from_goal(goal)}
                for what, pose in ends.items():
                    at = pose.position.round(3).tolist()
                    is_reached = any(reach.at_all(hand_down(at, yaw)) for yaw in symmetric_yaws(0.0, 8))
                    assert is_reached, f"the {what} of {goal.object} of episode {index}, {at}"

    def test_doing_nothing_is_a_failure(self) -> None:
        """Check that the success conditions do not hold at the start, so that they cannot hold by chance."""
        episode = self._episode(0)
        with make_world(episode.info) as world:
            world.reset(episode.info.simulated.scene)
            checks = episode.task.evaluate(world)
        assert checks, "the task has no conditions of success"
        assert not all(check.passed for check in checks), "the task is done before anything has moved"

    def test_the_expert_succeeds(self) -> None:
        """Check that the expert strictly succeeds at the first attempt in most episodes."""
        outcomes = [run_expert(self.task, self.robot, self.seed, index)[1] for index in range(self.num_episodes)]
        failed = [
            f"{index}: {outcome.failure_reason} in phase {outcome.failure_phase}"
            for index, outcome in enumerate(outcomes)
            if not outcome.success
        ]
        share = 1 - len(failed) / self.num_episodes
        assert share >= self.min_success, f"{share:.0%} of {self.num_episodes} episodes succeed; {'; '.join(failed)}"

    def test_commands_stay_within_the_limits_of_the_robot(self) -> None:
        """Check the expert's joint positions and velocities, and the gripper opening."""
        robot = self._episode(0).info.simulated.robot
        frames, _ = run_expert(self.task, self.robot, self.seed, 0)
        targets = np.array([frame.action.joint_target for frame in frames])
        widths = np.array([frame.action.gripper_target for frame in frames])
        speeds = np.abs(np.diff(targets, axis=0)) * self._episode(0).info.fps
        for joint, name in enumerate(robot.arm_joints):
            low, high = robot.position_lower[joint], robot.position_upper[joint]
            assert low - 1e-9 <= targets[:, joint].min(), f"{name} is commanded below its limit"
            assert targets[:, joint].max() <= high + 1e-9, f"{name} is commanded above its limit"
            assert speeds[:, joint].max() <= robot.velocity_limit[joint] * (1 + 1e-9), f"{name} is sent too fast"
        assert widths.min() >= 0, "the gripper command is negative"
        assert widths.max() <= robot.gripper.max_width + 1e-9, "the gripper command exceeds its maximum opening"

    def test_an_episode_repeats_to_the_bit(self) -> None:
        """Check that the script has no other source of randomness and leaves no state behind in a used world."""
        frames, outcome = run_expert(self.task, self.robot, self.seed, 0)
        episode = self._episode(0)
        with make_world(episode.info) as world:
            session = Session.of_episode(world, episode)
            list(itertools.islice(session.run(ScriptAgent(episode)), 20))
            again = list(session.run(ScriptAgent(episode)))
        assert session.outcome == outcome, "the outcome differs when the episode is run again"
        for old, new in zip(frames, again, strict=True):
            assert np.array_equal(old.command.joint_target, new.command.joint_target), (
                f"the command at frame {old.frame_index} differs when the episode is run again"
            )
            assert np.array_equal(old.observation.joint_position, new.observation.joint_position), (
                f"the arm's position at frame {old.frame_index} differs when the episode is run again"
            )

    def test_its_recording_passes_every_check_and_is_made_again_to_the_bit(self, tmp_path: Path) -> None:
        """Check that the checks find no fault, and that config and seed give the same recording again."""
        frames, outcome = run_expert(self.task, self.robot, self.seed, 0)
        path = tmp_path / "episode_000000.mcap"
        with EpisodeWriter(path, self._episode(0).info) as writer:
            for frame in frames:
                writer.write(frame)
            writer.finish(outcome)
        report = check_subject(Subject(path=path, kind="recording"), CheckOptions())
        failed = [f"{found.check}: {found.message}" for found in report.findings if found.severity == "broken"]
        assert not failed, "; ".join(failed)
        for proof in prove([path], modules_of([self.task, self.robot])):
            assert proof.level == "pass", proof.problem or "this machine cannot make the episode again"

    def _layouts(self) -> tuple[EpisodeInfo, ...]:
        return layouts_of(self.task, self.robot, self.seed, self.num_layouts)

    def _episode(self, index: int, *, attempt: int = 0) -> PreparedEpisode:
        return prepare(replace(plan_of(self.task, self.robot, self.seed, index), attempt=attempt))


class RobotContract:
    """Agreement of a robot's description with its URDF, and the arm's ability to do the tasks."""

    robot: ClassVar[str]  # name of a row of `demorec list robots`, or "package.module:NAME"
    seed: ClassVar[int] = 0  # root seed of the test's pick_place episode

    def test_the_spec_names_what_the_urdf_has(self) -> None:
        """Check that links and joints exist, are of the right kinds, and have limits within the URDF's."""
        spec = self._spec()
        text = asset_path(spec.urdf).read_text()
        urdf = Urdf.parse(text)
        problem = next(spec_problems(spec, urdf, read_dynamics(text)), "")
        assert not problem, problem
        if isinstance(spec.gripper, ParallelGripper):
            joints = {joint.name: joint for joint in urdf.joints}
            widest = spec.gripper.joint_position(spec.gripper.max_width).tolist()
            for name, position in zip(spec.gripper.joints, widest, strict=True):
                assert math.isclose(joints[name].upper, position), f"{name} at full opening is {position}"
        assert from_json(to_json(spec), RobotSpec) == spec, "the spec differs when it is read back from a file"

    def test_home_points_the_hand_down_with_the_fingers_across(self) -> None:
        """Check that the hand is upright over the table ahead in the rest configuration."""
        spec = self._spec()
        pose = arm_kinematics(spec).forward(np.array(spec.home_q))
        off = np.abs(pose.rotation - hand_down((0, 0, 0), 0.0).rotation).max()
        assert off < 0.01, f"the hand at home_q is turned by about {off:.2f} rad"
        assert 0.2 < pose.position[0] / spec.task_scale < 0.6, f"the hand at home_q is {pose.position[0]:.2f} m ahead"
        assert abs(pose.position[1]) < 0.015, f"the hand at home_q is {pose.position[1]:.2f} m to the side"

    def test_the_fingers_move_along_y_of_the_tcp_and_reach_as_far_as_the_spec_says(self) -> None:
        """Check the fingers' boxes in the simulator, opened as tasks open them."""
        spec = self._spec()
        gripper, fingers = spec.gripper, finger_boxes(spec)
        assert np.abs(fingers.centres[:, 0]).max() < 0.01, "a finger is off the TCP's y axis"
        if isinstance(gripper, ParallelGripper):
            half = gripper.open_width / 2
            for y in np.abs(fingers.centres[:, 1]):
                assert half - 0.005 < y < half + 0.025, f"a finger is {y:.3f} m from the TCP"
        # PyBullet's boxes are a few millimetres too large.
        depth = fingers.depth
        assert abs(depth - gripper.finger_depth) < 0.005, f"the finger tips reach {depth:.3f} m beyond the TCP"

    def test_the_workspace_is_within_reach(self) -> None:
        """Check that the hand, pointing down at one of a grasp's two yaws, reaches the objects up to 22 cm high."""
        unreachable = unreachable_poses(self._spec())
        assert not unreachable, unreachable[0]

    def test_it_picks_and_places(self) -> None:
        """Check that one episode of pick_place succeeds."""
        _, outcome = run_expert("pick_place", self.robot, self.seed, 0)
        assert outcome.success, f"{outcome.failure_reason} in phase {outcome.failure_phase}"

    def _spec(self) -> RobotSpec:
        allowed = modules_of([self.robot])
        allow_models(allowed)
        return load_robot(self.robot, allowed)


def plan_of(task: str, robot: str, seed: int, index: int) -> EpisodePlan:
    """Return an episode's plan, without images."""
    config = GenerateConfig(task=task, robot=robot, seed=seed, cameras=())
    config.validate()
    return EpisodePlan(config=config, episode_index=index)


# The tests of a class run in sequence and share layouts and simulated episodes.
@lru_cache(maxsize=1)
def layouts_of(task: str, robot: str, seed: int, count: int) -> tuple[EpisodeInfo, ...]:
    """Draw the first episodes' descriptions."""
    return tuple(prepare(plan_of(task, robot, seed, index)).info for index in range(count))


@lru_cache(maxsize=16)
def run_expert(task: str, robot: str, seed: int, index: int) -> tuple[tuple[Frame, ...], Outcome]:
    """Simulate an episode; returns all frames and the outcome."""
    episode = prepare(plan_of(task, robot, seed, index))
    with make_world(episode.info) as world:
        session = Session.of_episode(world, episode)
        frames = tuple(session.run(ScriptAgent(episode)))
    return frames, session.outcome
