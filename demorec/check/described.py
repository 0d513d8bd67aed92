"""Does what is said about the episode agree with itself: config, task, words, robot, scene, noise."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from demorec.annotate.situation import COLOR_WORDS
from demorec.check.base import Found, Measurement, NotMeasured, alignment_check, outcome_check
from demorec.check.episode import CheckedEpisode
from demorec.core.errors import ConfigError
from demorec.core.plain import digest, from_plain
from demorec.core.tables import ROBOTS, camera_name, load_robot
from demorec.episode.episode import POLICY_PHASE
from demorec.episode.scene import Scene
from demorec.episode.variation import Ranges, resolve

_MARGIN = 1e-9
"""By how much a drawn number may be beyond its range: it was turned and scaled."""
_SIGMAS = 8.0
"""Standard deviations within which every normally distributed number lies."""


@outcome_check(
    measures="statements about the episode that its config contradicts",
    reads=(
        "info.config",
        "info.config_digest",
        "info.task",
        "info.root_seed",
        "info.attempt",
        "info.scene.robot.name",
        "info.fps",
        "info.physics_hz",
        "info.scene.physics.hz",
        "info.scene.cameras.name",
        "cameras.video",
        "cameras.depth",
        "cameras.segmentation",
    ),
)
def config_agrees(episode: CheckedEpisode) -> Found:
    """Task, robot, seed, rates, cameras, sizes and codec are those of the config, whose digest is recomputed."""
    info = episode.info
    if not info.config:
        return NotMeasured(why="the recording has no config")
    wrong = [f"{name} is {found!r}, the config says {said!r}" for name, found, said in _statements(episode)
             if found != said]  # fmt: skip
    if digest(dict(info.config)) != info.config_digest:
        wrong.append(f"the config's digest is {digest(dict(info.config))}, not {info.config_digest!r}")
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]))


def _statements(episode: CheckedEpisode) -> Iterator[tuple[str, object, object]]:
    """What is said, how it is, and how the config has it."""
    info, config = episode.info, episode.info.config
    found: dict[str, Any] = {"task": info.task, "seed": info.root_seed, "fps": info.fps, "physics_hz": info.physics_hz}
    for name, value in found.items():
        yield name, value, config.get(name, value)
    yield "robot of the scene", info.scene.robot.name, info.robot.name
    yield "physics rate of the scene", info.scene.physics.hz, info.physics_hz
    if "max_attempts" in config:
        yield "attempt within the allowed", info.attempt < int(config["max_attempts"]), True
    if "robot" in config and config["robot"] in ROBOTS.rows:
        yield "robot", info.robot.name, config["robot"]
    if "cameras" not in config or info.origin:  # a rendering may have cameras of its own
        return
    yield "cameras", [camera.name for camera in episode.cameras], [camera_name(str(n)) for n in config["cameras"]]
    for camera in episode.cameras:
        video = episode.recording.video_settings(camera.name)
        yield f"codec of {camera.name}", video.codec, config.get("video", {}).get("codec", video.codec)
        yield f"GOP of {camera.name}", video.gop, 1 if video.codec == "jpeg" else config.get("video", {}).get(
            "gop", video.gop)  # fmt: skip
        yield f"depth of {camera.name}", episode.recording.has_depth(camera.name), bool(config.get("depth"))
        labels = episode.recording.has_segmentation(camera.name)
        yield f"segmentation of {camera.name}", labels, bool(config.get("segmentation"))


@outcome_check(
    measures="things of the robot that its table has otherwise",
    reads=("info.robot", "info.scene.robot.scale"),
)
def robot_as_known(episode: CheckedEpisode) -> Found:
    """Limits, joints and links of one of demorec's own robots are those of its table, scaled as the scene says."""
    info = episode.info
    if info.robot.name not in ROBOTS.rows:
        return NotMeasured(why=f"the robot {info.robot.name!r} is none of demorec's own")
    try:
        known = load_robot(info.robot.name).scaled(info.scene.robot.scale)
    except ConfigError as error:
        return NotMeasured(why=str(error))
    fields = type(known).__dataclass_fields__
    wrong = [name for name in fields if getattr(known, name) != getattr(info.robot, name)]
    return Measurement(value=len(wrong), detail=", ".join(wrong[:5]))


@outcome_check(
    measures="colours that the instruction names and the scene lacks, or the other way round",
    reads=(
        "info.instruction",
        "info.scene.bodies.color_name",
        "info.scene.goals.object",
    ),
)
def instruction_fits_scene(episode: CheckedEpisode) -> Found:
    """The instruction speaks of colours that are in the scene, and of those of the objects that have a goal."""
    scene = episode.info.scene
    words = [word for word in re.findall(r"[a-z]+", episode.info.instruction.lower()) if word in COLOR_WORDS]
    if not episode.info.instruction.strip():
        return Measurement(value=1, detail="there is no instruction")
    known = {body.color_name for body in scene.bodies if body.color_name}
    if not words:
        return NotMeasured(why="the instruction names no colour")
    wrong = [f"nothing is {word}" for word in dict.fromkeys(words) if word not in known]
    wrong += [f"{color} is not named" for color in _goal_colors(scene) if color not in words]
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or episode.info.instruction)


def _goal_colors(scene: Scene) -> list[str]:
    """Colours of the objects that shall go somewhere, each once."""
    return list(dict.fromkeys(name for goal in scene.goals if (name := scene.body(goal.object).color_name)))


@outcome_check(
    measures="numbers drawn for the episode that its variation does not allow",
    reads=("info.behaviour", "info.config"),
)
def drawn_within_ranges(episode: CheckedEpisode) -> Found:
    """Speed, heights, misses, errors of perception and calibration lie in the ranges that the config asks for.

    So a calibration error is only as large as the variation makes it, however well it explains the pictures.
    """
    info = episode.info
    try:
        ranges = resolve(info.config["variation"], from_plain(info.config["ranges"], Ranges))
        ranges.validate()
    except (KeyError, TypeError, ValueError, ConfigError):
        return NotMeasured(why="the config has no ranges that are known")
    drawn = info.behaviour
    allowed = dict([*_ranges_drawn(ranges), *_calibration_ranges(drawn, ranges)])
    wrong = [
        f"{name} is {drawn[name]:.4g}, allowed are {low:.4g} to {high:.4g}"
        for name, (low, high) in allowed.items()
        if name in drawn and not low - _MARGIN <= drawn[name] <= high + _MARGIN
    ]
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]))


def _ranges_drawn(ranges: Ranges) -> Iterator[tuple[str, tuple[float, float]]]:
    """Name of a number -> (low, high) that it was drawn from."""
    for name in ("speed", "approach_height", "lift_height", "grasp_offset"):
        yield name, ranges.range(name)
    # A policy, and the expert who takes over from one, act without noise.
    yield "action_noise", (0.0, ranges.range("action_noise")[1])
    miss = ranges.range("miss_distance")[1] if ranges.number("miss_probability") else 0.0
    error, yaw = _SIGMAS * ranges.number("perception_error"), _SIGMAS * ranges.number("perception_yaw")
    for name, most in (("miss_x", miss), ("miss_y", miss), ("perception_x", error), ("perception_y", error)):
        yield name, (-most, most)
    yield "perception_yaw", (-yaw, yaw)


def _calibration_ranges(names: Iterable[str], ranges: Ranges) -> Iterator[tuple[str, tuple[float, float]]]:
    """The same of those numbers that tell calibration errors, each for one camera and one axis."""
    position, half = ranges.number("calibration_position"), ranges.number("calibration_rotation") / 2
    allowed = {"x": position, "y": position, "z": position, "qx": half, "qy": half, "qz": half}
    for name in names:
        word = name.rpartition("_")[2]
        if name.startswith("calibration_") and word == "angle":
            yield name, (0.0, 2 * math.atan(math.sqrt(3) * half))
        elif name.startswith("calibration_") and word in allowed:
            yield name, (-allowed[word], allowed[word])


@alignment_check(
    measures="exploration noise on the commands against what the behaviour says, factor off 1",
    reads=(
        "/action",
        "/command",
        "info.behaviour",
    ),
)
def noise_as_said(episode: CheckedEpisode) -> Found:
    """Commands differ from labels by noise of the size that the behaviour names, and not at all where it names none."""
    c, behaviour = episode.columns, episode.info.behaviour
    if "action_noise" not in behaviour:
        return NotMeasured(why="the behaviour names no exploration noise")
    if POLICY_PHASE in c.phase:
        return NotMeasured(why="a policy acted, on whom no noise is put")
    noise = c.command_joint_target - c.action_joint_target
    sigma = behaviour["action_noise"]
    loud = np.abs(noise).max(axis=1, initial=0.0)
    if sigma == 0.0:
        frame = int(np.argmax(loud)) if len(loud) else None
        return Measurement(value=0.0 if loud.max(initial=0.0) < 1e-9 else 1.0, frame=frame, detail="none is said")
    noisy = loud > 0.5 * sigma
    if loud.max(initial=0.0) < 1e-9 and any(c.phase):
        return Measurement(value=1.0, detail=f"{sigma:.4f} rad are said, there is none")
    if noisy.sum() < 15:
        return NotMeasured(why=f"{int(noisy.sum())} frames have noise")
    found = float(np.sqrt((noise[noisy] ** 2).mean()))
    return Measurement(value=abs(found / sigma - 1), detail=f"{found:.4f} rad, {sigma:.4f} rad are said")
