"""What share of faults in the numbers `demorec check` finds: in recordings, and in what real rigs and converters make.

    python benchmarks/faults.py                    # a table of the faults that are not found, and both shares
    python benchmarks/faults.py --half looked      # only the half that was looked at when laws were written
    python benchmarks/faults.py --all              # every fault, with the checks that find it

Good recordings of several tasks, arms and rates are changed in memory, one fault at a time, and judged by all checks
that look at numbers. Every second fault of the lists belongs to the half that was only measured (`held out`). Faults of
other people's data are made of the same recordings, stripped of their scene and of all that only demorec knows.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from check_limits import record
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from support.faults import Changed

from demorec.check.base import Form, Result
from demorec.check.episode import CheckedEpisode
from demorec.check.evidence import Motions, motion_of_features
from demorec.check.rows import matrices
from demorec.core.config import GenerateConfig
from demorec.core.tables import CHECKS
from demorec.episode.episode import frame_time_ns
from demorec.episode.info import Feature
from demorec.episode.words import COLOR_WORDS

Rows = NDArray[Any]
Fault = Callable[[Changed], Changed]
Features = dict[str, Rows]
Strange = Callable[[Features], Features]

GOOD = (
    GenerateConfig(task="pick_place", robot="panda", variation="mild", seed=501, fps=30, cameras=()),
    GenerateConfig(task="stack", robot="iiwa", variation="full", seed=502, fps=20, cameras=()),
    GenerateConfig(task="sort_by_color", robot="panda", variation="none", seed=503, fps=60, cameras=()),
)


def late(rows: Rows, by: int) -> Rows:
    """So many frames late, or early."""
    return rows[np.clip(np.arange(len(rows)) - by, 0, len(rows) - 1)]


def filtered(rows: Rows, keep: float = 0.8) -> Rows:
    """A low-pass filter of the first order."""
    out = rows.astype(np.float64).copy()
    for t in range(1, len(out)):
        out[t] = keep * out[t - 1] + (1 - keep) * rows[t]
    return out


def spiky(rows: Rows, times: float = 5.0) -> Rows:
    """Three single frames far off."""
    out = rows.copy()
    out[[len(out) // 4, len(out) // 2, 3 * len(out) // 4]] *= times
    return out


def column(name: str, change: Callable[[Rows], Rows]) -> Fault:
    """Another column."""
    return lambda c: c.with_columns(**{name: change(getattr(c.columns, name))})


def wrench(change: Callable[[Rows], Rows]) -> Fault:
    """Another wrench."""
    return lambda c: c.with_columns(sensed={"wrench": change(c.columns.sensed["wrench"])})


def torque(change: Callable[[Rows], Rows]) -> Fault:
    """Another torque of the wrench."""
    return wrench(lambda rows: np.column_stack([rows[:, :3], change(rows[:, 3:])]))


def of_arm(change: Callable[[Rows], Rows]) -> Callable[[Rows], Rows]:
    """Other values of the arm's seven joints."""
    return lambda rows: np.column_stack([change(rows[:, :7]), rows[:, 7:]])


def times(where: int, factor: float) -> Callable[[Rows], Rows]:
    """One column times a factor."""

    def change(rows: Rows) -> Rows:
        out = rows.copy()
        out[:, where] *= factor
        return out

    return change


def plus(where: int, by: float, since: float = 0.0) -> Callable[[Rows], Rows]:
    """One column more, from a share of the frames on."""

    def change(rows: Rows) -> Rows:
        out = rows.copy()
        out[int(since * len(out)) :, where] += by
        return out

    return change


def swapped(one: int, other: int) -> Callable[[Rows], Rows]:
    """Two columns exchanged."""

    def change(rows: Rows) -> Rows:
        out = rows.copy()
        out[:, [one, other]] = rows[:, [other, one]]
        return out

    return change


def goal_object(c: Changed) -> str:
    """What the first goal moves."""
    return c.info.scene.goals[0].object


def thing(change: Callable[[Changed, Rows], Rows]) -> Fault:
    """Other poses of what the first goal moves."""

    def fault(c: Changed) -> Changed:
        name = goal_object(c)
        poses = {**c.columns.object_poses, name: change(c, c.columns.object_poses[name].copy())}
        return c.with_columns(object_poses=poses)

    return fault


def turned(poses: Rows, angle: float) -> Rows:
    """Poses turned about the vertical."""
    x, y, z, w = poses[:, 3:].T
    s, k = np.sin(angle / 2), np.cos(angle / 2)
    return np.column_stack([poses[:, :3], k * x - s * y, k * y + s * x, k * z + s * w, k * w - s * z])


def in_phase(c: Changed, *names: str) -> Rows:
    """Rows of the first pick and place in these phases."""
    found = np.flatnonzero(np.isin(c.columns.phase, names))
    breaks = np.flatnonzero(np.diff(found) > len(c.columns.phase) // 6)
    return found[: breaks[0] + 1] if len(breaks) else found


def jump_of_rotation(c: Changed, poses: Rows) -> Rows:
    rows = slice(3, 4)
    poses[rows] = turned(poses[rows], 0.35)
    return poses


def jump_in_the_hand(c: Changed, poses: Rows) -> Rows:
    rows = in_phase(c, "transport")
    middle = rows[len(rows) // 2]
    poses[middle] = turned(poses[middle : middle + 1], 0.5)[0]
    return poses


def quarter_turn(c: Changed, poses: Rows) -> Rows:
    poses[len(poses) // 2 :] = turned(poses[len(poses) // 2 :], np.pi / 2)
    return poses


def _follow(c: Changed, poses: Rows, rows: Rows, anchor: int) -> Rows:
    hand = matrices(c.columns.base_from_tcp)
    at = poses[anchor, :3] - hand[anchor, :3, 3]
    poses[rows, :3] = hand[rows, :3, 3] + at
    return poses


def glued(c: Changed, poses: Rows) -> Rows:
    rows = in_phase(c, "release")
    return _follow(c, poses, np.arange(rows[0], len(poses)), rows[0])


def glued_early(c: Changed, poses: Rows) -> Rows:
    rows = in_phase(c, "descend")[-6:]
    return _follow(c, poses, rows, rows[-1])


def stays_in_the_air(c: Changed, poses: Rows) -> Rows:
    rows = in_phase(c, "lower")
    poses[rows[len(rows) // 3] :] = poses[rows[len(rows) // 3]]
    return poses


def slow_drop(c: Changed, poses: Rows) -> Rows:
    first = in_phase(c, "lower")[0]
    last = min(first + 2 * c.info.fps, len(poses) - 1)
    share = np.linspace(0, 1, last - first + 1)[:, None]
    poses[first : last + 1, :3] = (1 - share) * poses[first, :3] + share * poses[last, :3]
    return poses


def slips(c: Changed, poses: Rows) -> Rows:
    rows = in_phase(c, "transport")
    poses[rows, 2] -= np.linspace(0, 0.015, len(rows))
    return poses


def of_rows(c: Changed, rows: Rows) -> Changed:
    """The same recording of other frames, with the times that these have then."""
    values: dict[str, Any] = {}
    for name, value in vars(c.columns).items():
        if isinstance(value, Mapping):
            values[name] = {key: table[rows] for key, table in value.items()}
        else:
            values[name] = tuple(value[t] for t in rows) if isinstance(value, tuple) else value[rows]
    values["time_ns"] = np.array([frame_time_ns(t, c.info.fps) for t in range(len(rows))])
    return replace(c, columns=replace(c.columns, **values)).with_outcome(num_frames=len(rows))


def cut(first: int, last: int | None, out_of: tuple[int, int] | None = None) -> Fault:
    """Frames cut off at head or tail, or out of the middle."""

    def fault(c: Changed) -> Changed:
        count = c.columns.num_frames
        rows = np.arange(count)[first:last]
        if out_of is not None:
            rows = np.delete(rows, np.s_[count // 2 : count // 2 + out_of[1]])
        return of_rows(c, rows)

    return fault


def repeated_start(c: Changed) -> Changed:
    """The first frame ten times."""
    return of_rows(c, np.concatenate([np.zeros(9, dtype=int), np.arange(c.columns.num_frames)]))


def condition(part: str, **fields: Any) -> Fault:
    """Conditions whose name begins so say something else; functions are given the condition."""

    def fault(c: Changed) -> Changed:
        checks = []
        for check in c.outcome.checks:
            if check.name.partition(":")[0] == part:
                values = {key: value(check) if callable(value) else value for key, value in fields.items()}
                check = replace(check, **values)
            checks.append(check)
        return c.with_outcome(checks=tuple(checks))

    return fault


def without(part: str) -> Fault:
    """A condition less."""
    return lambda c: c.with_outcome(
        checks=tuple(check for check in c.outcome.checks if check.name.partition(":")[0] != part)
    )


def goal_moved(by: float) -> Fault:
    """The last goal elsewhere."""

    def fault(c: Changed) -> Changed:
        goal = c.info.scene.goals[-1]
        pose = replace(goal.onto_from_goal, position=goal.onto_from_goal.position + np.array([by, 0.0, 0.0]))
        goals = (*c.info.scene.goals[:-1], replace(goal, onto_from_goal=pose))
        return c.with_info(scene=replace(c.info.scene, goals=goals))

    return fault


def colors_exchanged(c: Changed) -> Changed:
    """What is moved and what it goes to have each other's colours in the instruction."""
    words = c.info.instruction.split()
    known = {body.color_name for body in c.info.scene.bodies if body.color_name}
    places = [i for i, word in enumerate(words) if word.strip(",.:") in known]
    if not places:
        return c
    one, other = places[0], next(i for i in places if words[i].strip(",.:") != words[places[0]].strip(",.:"))
    words[one], words[other] = words[other], words[one]
    return c.with_info(instruction=" ".join(words))


def first_colors_exchanged(c: Changed) -> Changed:
    """The first colours of an instruction that names several have changed places everywhere in it."""
    words = re.findall("[a-z]+", c.info.instruction)
    known = list(dict.fromkeys(word for word in words if word in COLOR_WORDS))
    if len(known) < 2:
        return c
    other = {known[0]: known[1], known[1]: known[0]}
    text = re.sub("[a-z]+", lambda found: other.get(found[0], found[0]), c.info.instruction)
    return c.with_info(instruction=text) if text != c.info.instruction else c


def another_color(c: Changed) -> Changed:
    """What is moved has the colour of something else on the table."""
    moved = c.info.scene.body(goal_object(c)).color_name
    others = [body.color_name for body in c.info.scene.bodies if body.color_name not in ("", moved)]
    if not others or moved not in c.info.instruction:
        return c
    return c.with_info(instruction=c.info.instruction.replace(moved, others[-1], 1))


def held_at_release(rows: Rows) -> Rows:
    """Where the force falls to nothing it stays for three frames more."""
    out = rows.copy()
    for t in np.flatnonzero((rows[:-1] > 1) & (rows[1:] == 0)) + 1:
        out[t : t + 3] = rows[t - 1]
    return out


def carrying(name: str, change: Callable[[Rows], Rows]) -> Fault:
    """Other values in a single frame in the midst of carrying."""

    def fault(c: Changed) -> Changed:
        rows = c.columns.sensed[name] if name in c.columns.sensed else getattr(c.columns, name)
        out, where = rows.copy(), in_phase(c, "transport")
        frame = where[2 * len(where) // 3]
        out[frame : frame + 1] = change(rows[frame : frame + 1])
        return c.with_columns(**({"sensed": {name: out}} if name in c.columns.sensed else {name: out}))

    return fault


def scene_body(**fields: Any) -> Fault:
    """What the first goal moves is said to be otherwise; functions are given the body."""

    def fault(c: Changed) -> Changed:
        name = goal_object(c)
        bodies = [
            replace(body, **{key: value(body) for key, value in fields.items()}) if body.name == name else body
            for body in c.info.scene.bodies
        ]
        return c.with_info(scene=replace(c.info.scene, bodies=tuple(bodies)))

    return fault


SIMULATED: tuple[tuple[str, Fault], ...] = (
    ("torque of the wrench zero", torque(lambda r: 0 * r)),
    ("torque of the wrench inverted", torque(lambda r: -r)),
    ("torque of the wrench in N mm", torque(lambda r: 1000 * r)),
    ("torque of the wrench + 0.5 N m", torque(plus(1, 0.5))),
    ("wrench two frames late", wrench(lambda r: late(r, 2))),
    ("wrench two frames early", wrench(lambda r: late(r, -2))),
    ("wrench filtered", wrench(filtered)),
    ("wrench filtered much", wrench(lambda r: filtered(r, 0.93))),
    ("spikes of the wrench", wrench(spiky)),
    ("spikes of force", wrench(lambda r: np.column_stack([spiky(r[:, :3], 3.0), r[:, 3:]]))),
    ("wrench + 3 N untared", wrench(plus(2, 3.0))),
    ("wrench + 2 N sideways", wrench(plus(0, 2.0))),
    ("force of the wrench x 0.8", wrench(lambda r: r * [0.8, 0.8, 0.8, 1, 1, 1])),
    ("wrench backwards", wrench(lambda r: r[::-1])),
    ("efforts of two light joints exchanged", column("joint_effort", swapped(4, 6))),
    ("efforts of the last joints exchanged", column("joint_effort", swapped(5, 6))),
    ("efforts 30 % too small", column("joint_effort", of_arm(lambda r: 0.7 * r))),
    ("effort of one joint 30 % too small", column("joint_effort", times(3, 0.7))),
    ("efforts three frames late", column("joint_effort", of_arm(lambda r: late(r, 3)))),
    ("efforts three frames early", column("joint_effort", of_arm(lambda r: late(r, -3)))),
    ("efforts filtered", column("joint_effort", of_arm(lambda r: filtered(r, 0.9)))),
    ("effort of a light joint inverted", column("joint_effort", times(4, -1.0))),
    ("effort of the last joint zero", column("joint_effort", times(6, 0.0))),
    ("spikes of effort", column("joint_effort", of_arm(lambda r: spiky(r, 2.0)))),
    ("effort of one joint + 3 N m", column("joint_effort", plus(2, 3.0))),
    ("contact force three frames late", column("contact_force", lambda r: late(r, 3))),
    ("contact force of spikes", column("contact_force", lambda r: spiky(r, 3.0))),
    ("limit of the tilt doubled", condition("tilt", limit=lambda c: 2 * c.limit)),
    ("limit of the distance 5 cm", condition("distance_to_goal", limit=0.05)),
    ("tilt that is none of the last frame", condition("tilt", value=0.06)),
    ("height error that is none of the last frame", condition("height_error", value=0.0035)),
    ("opening that is none of the last frame", condition("gripper_width", value=lambda c: c.value - 0.004)),
    ("passed though beyond its limit", condition("speed", value=0.2)),
    ("a condition less", without("tilt")),
    ("the condition of letting go less", without("gripper_width")),
    ("a condition renamed", condition("tilt", name="lean")),
    ("touched, and passed", condition("touched_by_robot", value=1.0)),
    ("colours of object and goal exchanged", colors_exchanged),
    ("goal 1 cm off", goal_moved(0.01)),
    ("goal 4 cm off", goal_moved(0.04)),
    ("mass doubled", scene_body(mass=lambda b: b.mass + 0.3)),
    ("size 8 % larger", scene_body(shape=lambda b: replace(b.shape, size=tuple(1.08 * v for v in b.shape.size)))),
    ("ten frames cut at the head", cut(10, None)),
    ("three frames cut at the head", cut(3, None)),
    ("15 frames cut at the tail", cut(0, -15)),
    ("five frames cut at the tail", cut(0, -5)),
    ("ten frames cut out", cut(0, None, (0, 10))),
    ("four frames cut out", cut(0, None, (0, 4))),
    ("first frame ten times", repeated_start),
    ("velocities 8 % too small", column("joint_velocity", of_arm(lambda r: 0.92 * r))),
    ("velocity of one joint 8 % too small", column("joint_velocity", times(1, 0.92))),
    ("velocities two frames late", column("joint_velocity", of_arm(lambda r: late(r, 2)))),
    ("an object's rotation jumps", thing(jump_of_rotation)),
    ("an object's rotation jumps in the hand", thing(jump_in_the_hand)),
    ("an object's rotation a quarter off", thing(quarter_turn)),
    ("an object glued to the hand", thing(glued)),
    ("an object glued to the hand early", thing(glued_early)),
    ("an object stays in the air", thing(stays_in_the_air)),
    ("an object sinks slowly by itself", thing(slow_drop)),
    ("an object slips by 15 mm", thing(slips)),
    ("objects two frames late", thing(lambda c, r: late(r, 2))),
    ("objects one frame early", thing(lambda c, r: late(r, -1))),
    ("contact force two frames late", column("contact_force", lambda r: late(r, 2))),
    ("contact force two frames early", column("contact_force", lambda r: late(r, -2))),
    ("contact force of one frame doubled", carrying("contact_force", lambda r: 2 * r)),
    ("contact force of one frame zero", carrying("contact_force", lambda r: 0 * r)),
    ("wrench of one frame zero", carrying("wrench", lambda r: 0 * r)),
    ("wrench of one frame of another sign", carrying("wrench", lambda r: -r)),
    ("efforts of one frame zero", carrying("joint_effort", lambda r: 0 * r)),
    ("efforts of one frame a tenth", carrying("joint_effort", lambda r: 0.1 * r)),
    ("force of the wrench of one frame + 6 N", carrying("wrench", lambda r: np.add(r, [0, 6, 0, 0, 0, 0]))),
    ("effort of the second joint of one frame x 1.8", carrying("joint_effort", times(1, 1.8))),
    ("contact force held for three frames at release", column("contact_force", held_at_release)),
    ("contact force four frames late", column("contact_force", lambda r: late(r, 4))),
    ("colours of the first two words exchanged", first_colors_exchanged),
    ("a colour of another object", another_color),
)  # fmt: skip


def state(change: Callable[[Rows], Rows]) -> Strange:
    """Another state."""
    return lambda f: {**f, "observation.state": change(f["observation.state"])}


def action(change: Callable[[Rows], Rows]) -> Strange:
    """Another action."""
    return lambda f: {**f, "action": change(f["action"])}


def velocity(change: Callable[[Rows], Rows]) -> Strange:
    """Another velocity."""
    return lambda f: {**f, "observation.velocity": change(f["observation.velocity"])}


def everything(change: Callable[[Rows], Rows]) -> Strange:
    """All features alike."""
    return lambda f: {name: change(rows) for name, rows in f.items()}


def slipped(rows: Rows) -> Rows:
    return plus(2, 0.08, since=0.5)(rows)


def backlash(rows: Rows, width: float = 0.03) -> Rows:
    """Hysteresis: the encoder of one joint follows only at the end of its play."""
    out = rows.copy()
    for t in range(1, len(out)):
        out[t, 1] = min(max(out[t - 1, 1], rows[t, 1] - width / 2), rows[t, 1] + width / 2)
    return out


def coarse(rows: Rows, step: float, joints: tuple[int, ...] = tuple(range(7))) -> Rows:
    """Encoders of so many rad a step."""
    out = rows.copy()
    out[:, joints] = np.round(rows[:, joints] / step) * step
    return out


def interpolated(rows: Rows) -> Rows:
    """Every second frame is the mean of its neighbours."""
    out = rows.copy()
    inner = out[1:-1:2]
    inner[:] = (out[0:-2:2][: len(inner)] + out[2::2][: len(inner)]) / 2
    return out


def late_when_opening(rows: Rows) -> Rows:
    """The gripper's action 15 frames late where it opens."""
    out, opening = rows.copy(), rows[:, -1]
    for t in np.flatnonzero(np.diff(opening) > 0.01) + 1:
        out[t : t + 15, -1] = opening[t - 1]
    return out


def normalised_twice(rows: Rows) -> Rows:
    return np.asarray((rows - rows.mean(axis=0)) / np.maximum(rows.std(axis=0), 1e-6))


def repeats(rows: Rows) -> Rows:
    """Every fifth frame repeats the one before."""
    out = rows.copy()
    out[5::5] = out[4:-1:5]
    return out


def next_observation(f: Features) -> Features:
    return {**f, "action": np.concatenate([f["observation.state"][1:], f["observation.state"][-1:]])}


def in_other_base(f: Features) -> Features:
    """The pose in a frame that is turned by 30 degrees from the middle on."""
    poses = f["observation.ee_pose"].copy()
    half = len(poses) // 2
    c, s = np.cos(0.5), np.sin(0.5)
    poses[half:, :2] = poses[half:, :2] @ np.array([[c, s], [-s, c]])
    return {**f, "observation.ee_pose": poses}


def pose(change: Callable[[Rows], Rows]) -> Strange:
    """Another EE pose."""
    return lambda f: {**f, "observation.ee_pose": change(f["observation.ee_pose"])}


STRANGE: tuple[tuple[str, Strange], ...] = (
    ("degrees in one joint", state(times(3, 57.3))),
    ("degrees in one joint of the action", action(times(3, 57.3))),
    ("an encoder slips by 0.08 rad", state(slipped)),
    ("backlash of 0.03 rad", state(backlash)),
    ("resampled by interpolation", state(interpolated)),
    ("all resampled by interpolation", everything(interpolated)),
    ("action is the next observation", next_observation),
    ("action is the observation", lambda f: {**f, "action": f["observation.state"].copy()}),
    ("gripper's action inverted", action(lambda r: np.column_stack([r[:, :-1], r[:, -1].max() - r[:, -1]]))),
    ("gripper late only when opening", action(late_when_opening)),
    ("quaternion with its scalar first", pose(lambda r: r[:, [0, 1, 2, 6, 3, 4, 5]])),
    ("pose in another frame from the middle on", in_other_base),
    ("ten frames dropped", everything(lambda r: np.delete(r, np.s_[len(r) // 2 : len(r) // 2 + 10], axis=0))),
    ("every fifth frame repeated", everything(repeats)),
    ("velocity of one joint inverted", velocity(times(2, -1.0))),
    ("state of two joints exchanged", state(swapped(1, 3))),
    ("one joint off by a turn", state(plus(6, 2 * np.pi, since=0.5))),
    ("action of another course", action(lambda r: r[::-1])),
    ("normalised twice", everything(normalised_twice)),
    ("action five frames late", action(lambda r: late(r, 5))),
    ("sign of a joint", state(times(2, -1.0))),
    ("encoder of coarse steps", state(lambda r: np.column_stack([np.round(r[:, :7] / 0.03) * 0.03, r[:, 7:]]))),
    ("velocities in degrees", velocity(lambda r: 57.3 * r)),
    ("pose three frames late", pose(lambda r: late(r, 3))),
    ("state filtered", state(lambda r: filtered(r, 0.85))),
    ("gripper never moves", state(lambda r: np.column_stack([r[:, :-1], 0 * r[:, -1] + r[0, -1]]))),
    ("backlash of 0.06 rad", state(lambda r: backlash(r, 0.06))),
    ("backlash of 0.04 rad", state(lambda r: backlash(r, 0.04))),
    ("encoder of 8 bits", state(lambda r: coarse(r, 2 * np.pi / 256))),
    ("encoder of 7 bits in two joints", state(lambda r: coarse(r, 2 * np.pi / 128, (1, 3)))),
)  # fmt: skip

_OF_MOTION = ("motion", "frames", "targets", "mounts", "directions")
"""Modules whose checks of external recordings are about numbers."""


class Stranger:
    """An episode of which only arrays, names and the robot by its joints are known."""

    form: ClassVar[Form] = "external"

    def __init__(self, features: Features, names: Mapping[str, tuple[str, ...]], fps: int) -> None:
        described = [Feature(name=name, names=elements) for name, elements in names.items()]
        motion = motion_of_features(features, described, fps)
        assert motion is not None
        self.motions = Motions([motion])


def features_of(episode: CheckedEpisode) -> tuple[Features, dict[str, tuple[str, ...]]]:
    """What another robot's recording would have."""
    c, robot = episode.columns, episode.info.robot
    n, arm = len(robot.arm_joints), robot.arm_joints
    features = {
        "observation.state": np.column_stack([c.joint_position[:, :n], c.gripper_width]),
        "observation.velocity": c.joint_velocity[:, :n].copy(),
        "observation.effort": c.joint_effort[:, :n].copy(),
        "observation.ee_pose": c.base_from_tcp.copy(),
        "action": np.column_stack([c.action_joint_target, c.action_gripper]),
    }
    names = {
        "observation.state": (*(f"{joint}.pos" for joint in arm), "gripper.width"),
        "observation.velocity": tuple(f"{joint}.vel" for joint in arm),
        "observation.effort": tuple(f"{joint}.effort" for joint in arm),
        "observation.ee_pose": ("x", "y", "z", "qx", "qy", "qz", "qw"),
        "action": (*(f"{joint}.pos" for joint in arm), "gripper.width"),
    }
    return features, names


def judge(subject: Any) -> dict[str, Result]:
    """What the checks of numbers say that do not pass it."""
    found = {}
    for name in CHECKS.names():
        check = CHECKS.load(name)
        is_motion = check.measure.__module__.rpartition(".")[2] in _OF_MOTION
        if subject.form not in check.on or check.needs_images or check.group in ("file", "time"):
            continue
        if subject.form == "external" and not is_motion:
            continue
        result = check.run(subject)
        if result.level in ("warn", "fail"):
            found[name] = result
    return found


class InMemory(CheckedEpisode):
    """An episode whose columns have been replaced."""

    @property
    def num_frames(self) -> int:
        """Of the columns, not of the file."""
        return self.columns.num_frames


def simulated(path: Path) -> Iterator[tuple[str, dict[str, Result]]]:
    """(fault, what is said) of a good recording; "" for the good one."""
    good: tuple[tuple[str, Fault], ...] = (("", lambda c: c),)
    for name, fault in (*good, *SIMULATED):
        with InMemory(path) as episode:
            recording = episode.recording
            assert recording.outcome is not None
            before = Changed(columns=recording.columns(), info=recording.info, outcome=recording.outcome)
            changed = fault(before)
            if name and changed is before:
                continue  # there is nothing to be spoilt
            episode.__dict__["columns"] = changed.columns
            recording.info, recording.outcome = changed.info, changed.outcome
            yield name, judge(episode)


def strange(path: Path) -> Iterator[tuple[str, dict[str, Result]]]:
    """The same of what a stranger would have recorded."""
    with CheckedEpisode(path) as episode:
        features, names = features_of(episode)
        fps = episode.info.fps
    good: tuple[tuple[str, Strange], ...] = (("", lambda f: f),)
    for name, fault in (*good, *STRANGE):
        yield name, judge(Stranger(fault(features), names, fps))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--half", choices=["looked", "held", "both"], default="both")
    parser.add_argument("--all", action="store_true", help="print what finds each fault")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{number}.mcap" for number in range(len(GOOD))]
        for path, config in zip(paths, GOOD, strict=True):
            assert record(config, 0, path), config
        for kind, faults, measure in (("recordings", SIMULATED, simulated), ("other people's", STRANGE, strange)):
            said: dict[str, list[dict[str, Result]]] = {}
            for path in paths:
                for name, found in measure(path):
                    said.setdefault(name, []).append(found)
            for found in said.pop(""):
                for check, result in found.items():
                    print(f"GOOD {kind}: {check} {result.level} {result.value} {result.detail}")
            order = [name for name, _ in faults]
            for half, chosen in (("looked", order[::2]), ("held", order[1::2])):
                if args.half not in (half, "both"):
                    continue
                levels = [["fail" if any(r.level == "fail" for r in f.values()) else "warn" if f else "-"
                           for f in said[name]] for name in chosen]  # fmt: skip
                for name, row in zip(chosen, levels, strict=True):
                    if args.all or "-" in row or "warn" in row:
                        by = sorted({check for f in said[name] for check in f})
                        print(f"{half:6} {kind}: {name}: {' '.join(row)}   {', '.join(by)}")
                flat = [level for row in levels for level in row]
                print(f"{half:6} {kind}: {flat.count('fail')} of {len(flat)} fail, {flat.count('warn')} warned of, "
                      f"{len(chosen)} faults")  # fmt: skip


if __name__ == "__main__":
    main()
