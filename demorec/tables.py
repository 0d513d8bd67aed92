"""The tables of everything that a user can name, but for commands (`COMMANDS` in demorec/cli).

A row here and one file make a new one (CONTRIBUTING.md).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from demorec.registry import Registry
from demorec.safety.user_modules import modules_of, split_name
from demorec.scene.assets import model_name

if TYPE_CHECKING:
    from demorec.check.base import Check
    from demorec.export.exporter import Exporter
    from demorec.render import Renderer
    from demorec.render.cameras import CameraPreset
    from demorec.scene.robot import RobotSpec
    from demorec.tasks.base import Task

TASKS: Registry[type[Task]] = Registry(
    kind="task",
    rows={
        "pick_place": "demorec.tasks.pick_place:PickPlace",
        "place_in_tray": "demorec.tasks.place_in_tray:PlaceInTray",
        "stack": "demorec.tasks.stack:Stack",
        "stack_three": "demorec.tasks.stack:StackThree",
        "unstack": "demorec.tasks.stack:Unstack",
        "sort_by_color": "demorec.tasks.sort_by_color:SortByColor",
        "line_up": "demorec.tasks.line_up:LineUp",
        "pick_from_clutter": "demorec.tasks.pick_from_clutter:PickFromClutter",
        "pick_shapes": "demorec.tasks.pick_shapes:PickShapes",
        "tutorial": "demorec.tasks.tutorial:Tutorial",
    },
    subclass_of="demorec.tasks.base:Task",
)

ROBOTS: Registry[RobotSpec] = Registry(
    kind="robot",
    rows={"panda": "demorec.sim.robots.panda:PANDA", "iiwa": "demorec.sim.robots.iiwa:IIWA"},
    instance_of="demorec.scene.robot:RobotSpec",
)

CAMERAS: Registry[CameraPreset] = Registry(
    kind="camera",
    rows={
        "front": "demorec.render.cameras:FRONT",
        "wrist": "demorec.render.cameras:WRIST",
        "top": "demorec.render.cameras:TOP",
        "workspace": "demorec.render.cameras:WORKSPACE",
    },
    instance_of="demorec.render.cameras:CameraPreset",
)

RENDERERS: Registry[type[Renderer]] = Registry(
    kind="renderer",
    rows={
        "raster": "demorec.render.raster:RasterRenderer",
        "tiny": "demorec.sim.renderers.tiny:TinyRenderer",
        "egl": "demorec.sim.renderers.egl:EglRenderer",
    },
)

EXPORTERS: Registry[Exporter[Any]] = Registry(
    kind="format",
    rows={"lerobot": "demorec.lerobot.exporter:LEROBOT", "hdf5": "demorec.hdf5.exporter:HDF5"},
)

CHECKS: Registry[Check] = Registry(
    kind="check",
    rows={
        "opens": "demorec.check.file:opens",
        "checksums": "demorec.check.file:checksums",
        "topics": "demorec.check.file:topics",
        "readable": "demorec.check.file:readable",
        "complete": "demorec.check.file:complete",
        "latched_messages": "demorec.check.redundancy:latched_messages",
        "metadata_agrees": "demorec.check.redundancy:metadata_agrees",
        "phase_events": "demorec.check.redundancy:phase_events",
        "picture_messages": "demorec.check.redundancy:picture_messages",
        "frame_times": "demorec.check.timing:frame_times",
        "joint_sample_times": "demorec.check.timing:joint_sample_times",
        "stamps": "demorec.check.timing:stamps",
        "video_frames": "demorec.check.timing:video_frames",
        "outcome_consistent": "demorec.check.outcome:outcome_consistent",
        "end_values": "demorec.check.outcome:end_values",
        "story": "demorec.check.script:story",
        "deliberate_misses": "demorec.check.script:deliberate_misses",
        "config_agrees": "demorec.check.described:config_agrees",
        "drawn_within_ranges": "demorec.check.described:drawn_within_ranges",
        "robot_as_known": "demorec.check.described:robot_as_known",
        "instruction_fits_scene": "demorec.check.described:instruction_fits_scene",
        "final_state": "demorec.check.outcome:final_state",
        "at_rest_in_the_end": "demorec.check.outcome:at_rest_in_the_end",
        "finite_numbers": "demorec.check.physics:finite_numbers",
        "joint_position": "demorec.check.physics:joint_position",
        "joint_velocity": "demorec.check.physics:joint_velocity",
        "action_acceleration": "demorec.check.physics:action_acceleration",
        "joint_acceleration": "demorec.check.physics:joint_acceleration",
        "velocity_matches_position": "demorec.check.physics:velocity_matches_position",
        "forward_kinematics": "demorec.check.physics:forward_kinematics",
        "unit_quaternions": "demorec.check.physics:unit_quaternions",
        "gripper_width": "demorec.check.physics:gripper_width",
        "command_tracking": "demorec.check.physics:command_tracking",
        "action_matches_command": "demorec.check.physics:action_matches_command",
        "effort_bears_the_arm": "demorec.check.dynamics:effort_bears_the_arm",
        "wrench_bears_the_hand": "demorec.check.dynamics:wrench_bears_the_hand",
        "stuck_sensors": "demorec.check.dynamics:stuck_sensors",
        "joint_effort": "demorec.check.gripper:joint_effort",
        "gripper_label": "demorec.check.gripper:gripper_label",
        "gripper_follows": "demorec.check.gripper:gripper_follows",
        "grip_force": "demorec.check.gripper:grip_force",
        "touches_nothing": "demorec.check.gripper:touches_nothing",
        "idle_frames": "demorec.check.physics:idle_frames",
        "object_motion": "demorec.check.objects:object_motion",
        "teleports": "demorec.check.objects:teleports",
        "starts_as_scene_says": "demorec.check.objects:starts_as_scene_says",
        "penetration": "demorec.check.objects:penetration",
        "carried_by_gripper": "demorec.check.objects:carried_by_gripper",
        "finger_depth": "demorec.check.fingers:finger_depth",
        "wrench_holds_the_hand": "demorec.check.physics:wrench_holds_the_hand",
        "moving_frames": "demorec.check.redundancy:moving_frames",
        "derived_values": "demorec.check.redundancy:derived_values",
        "command_lag": "demorec.check.alignment:command_lag",
        "phases_match_motion": "demorec.check.script:phases_match_motion",
        "noise_as_said": "demorec.check.described:noise_as_said",
        "action_lag": "demorec.check.alignment:action_lag",
        "gripper_lag": "demorec.check.alignment:gripper_lag",
        "intrinsics": "demorec.check.calibration:intrinsics",
        "extrinsics": "demorec.check.calibration:extrinsics",
        "projection": "demorec.check.calibration:projection",
        "projected_size": "demorec.check.calibration:projected_size",
        "depth_matches_scene": "demorec.check.calibration:depth_matches_scene",
        "segmentation_matches_scene": "demorec.check.calibration:segmentation_matches_scene",
        "picture_lag": "demorec.check.calibration:picture_lag",
        "pictures_decode": "demorec.check.pictures:pictures_decode",
        "pictures_exposed": "demorec.check.pictures:pictures_exposed",
        "exposure": "demorec.check.pictures:exposure",
        "pictures_as_drawn": "demorec.check.pictures:pictures_as_drawn",
        "odd_pictures": "demorec.check.pictures:odd_pictures",
        "frozen": "demorec.check.pictures:frozen",
        "repeated_pictures": "demorec.check.pictures:repeated_pictures",
        "distinct_cameras": "demorec.check.pictures:distinct_cameras",
        "pixel_statistics": "demorec.check.pictures:pixel_statistics",
        "collected_opens": "demorec.check.collected:collected_opens",
        "collected_checksums": "demorec.check.collected:collected_checksums",
        "collected_readable": "demorec.check.collected:collected_readable",
        "collected_complete": "demorec.check.collected:collected_complete",
        "collected_drops": "demorec.check.collected:collected_drops",
        "collected_rate": "demorec.check.collected:collected_rate",
        "collected_gaps": "demorec.check.collected:collected_gaps",
        "collected_sample_age": "demorec.check.collected:collected_sample_age",
        "collected_picture_age": "demorec.check.collected:collected_picture_age",
        "collected_missing_pictures": "demorec.check.collected:collected_missing_pictures",
        "collected_joint_limits": "demorec.check.collected:collected_joint_limits",
        "collected_stuck": "demorec.check.collected:collected_stuck",
        "collected_pictures": "demorec.check.collected:collected_pictures",
        "collected_distinct_cameras": "demorec.check.collected:collected_distinct_cameras",
        "collected_run_files": "demorec.check.collected:collected_run_files",
        "import_times": "demorec.check.imported:import_times",
        "import_numbers": "demorec.check.imported:import_numbers",
        "import_pictures": "demorec.check.imported:import_pictures",
        "import_dropped": "demorec.check.imported:import_dropped",
        "run_files": "demorec.check.run:run_files",
        "run_agrees": "demorec.check.run:run_agrees",
        "run_duplicates": "demorec.check.run:run_duplicates",
        "run_coverage": "demorec.check.run:run_coverage",
        "run_dataset": "demorec.check.run:run_dataset",
        "run_dataset_content": "demorec.check.run_dataset:run_dataset_content",
        "dataset_readable": "demorec.check.dataset_files:dataset_readable",
        "dataset_counts": "demorec.check.dataset_files:dataset_counts",
        "dataset_videos": "demorec.check.dataset_files:dataset_videos",
        "dataset_schema": "demorec.check.dataset_schema:dataset_schema",
        "dataset_description": "demorec.check.dataset_schema:dataset_description",
        "dataset_statistics": "demorec.check.dataset_statistics:dataset_statistics",
        "dataset_episode_statistics": "demorec.check.dataset_statistics:dataset_episode_statistics",
        "dataset_pictures": "demorec.check.dataset_pictures:dataset_pictures",
        "dataset_picture_statistics": "demorec.check.dataset_pictures:dataset_picture_statistics",
        "dataset_pictures_as_drawn": "demorec.check.dataset_pictures:dataset_pictures_as_drawn",
        "dataset_picture_lag": "demorec.check.dataset_pictures:dataset_picture_lag",
        "dataset_duplicates": "demorec.check.dataset_motion:dataset_duplicates",
        "dataset_coverage": "demorec.check.dataset_motion:dataset_coverage",
        "dataset_joint_limits": "demorec.check.dataset_motion:dataset_joint_limits",
        "dataset_velocity": "demorec.check.dataset_motion:dataset_velocity",
        "dataset_forward_kinematics": "demorec.check.dataset_motion:dataset_forward_kinematics",
        "dataset_action_lag": "demorec.check.dataset_motion:dataset_action_lag",
        "dataset_sidecar": "demorec.check.dataset_files:dataset_sidecar",
        "dataset_robots": "demorec.check.dataset_robots:dataset_robots",
        "dataset_facts": "demorec.check.dataset_facts:dataset_facts",
        "dataset_progress": "demorec.check.dataset_facts:dataset_progress",
        "dataset_language": "demorec.check.dataset_language:dataset_language",
        "dataset_language_truth": "demorec.check.dataset_language:dataset_language_truth",
        "dataset_opens": "demorec.check.dataset_files:dataset_opens",
    },
)


def load_robot(name: str, allowed: Collection[str] = ()) -> RobotSpec:
    """`ROBOTS.load`, with the model of a robot of the user's own named as recordings name it.

    Raises:
        ConfigError: As `Registry.load`, or the model lies where a recording cannot name it.
    """
    robot = ROBOTS.load(name, allowed)
    module, *_ = modules_of([name]) or ("",)
    return replace(robot, urdf=model_name(robot.urdf, module)) if module else robot


def environment_name(task: str) -> str:
    """Gymnasium's name of a task's environment: "demorec/PickPlace-v0", or "demorec/Mine-v0" for "my_package:Mine"."""
    name = "".join(word.capitalize() for word in task.split("_")) if task in TASKS.rows else task.rpartition(":")[2]
    return f"demorec/{name}-v0"


def camera_name(name: str) -> str:
    """What a camera is called in recordings and datasets: the row's name, or "top" for "my_cameras:TOP"."""
    return name if split_name(name) is None else name.rpartition(":")[2].lower()
