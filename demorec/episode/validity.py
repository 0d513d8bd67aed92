"""Validity of an episode's description, read from a file or just made.

`demorec.core.plain` has already checked types; this module checks further assumptions of the program: positive sizes,
unique names, valid references. `demorec check` judges whether the numbers are *plausible*.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from demorec.core.config import MAX_PIXELS
from demorec.core.errors import SceneError
from demorec.core.geometry import Pose
from demorec.core.plain import from_json
from demorec.episode.info import Camera, EpisodeInfo, Feature, Simulation
from demorec.episode.mesh import decode_mesh
from demorec.episode.scene import Body, Scene, SceneCamera
from demorec.episode.simulated import with_simulation
from demorec.robots.urdf import Urdf

_MAX_BODIES = 255
"""Maximum number of bodies that segmentation images distinguish."""
_MAX_ELEMENTS = 4096
_RANGES: Mapping[str, tuple[float, float]] = {
    "episode_index": (0, 2**63 - 1),
    "attempt": (0, 2**31),
    "root_seed": (0, 2**63 - 1),
    "fps": (1, 10_000),
    "physics_hz": (1, 100_000),
    "hz": (1, 100_000),
    "scale": (1e-9, 1e4),
    "mass": (0, 1e6),
    "yaw_symmetry": (0, 360),
    "fov_y": (1e-3, math.pi - 1e-3),
}
"""Field -> its minimum and maximum, wherever it occurs."""
_SIZE_LENGTH = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "mesh": 3, "urdf": 3}
_MAX_LISTED = 5
_MAX_TEXT = 10_000
_FEATURE = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z][A-Za-z0-9_]*)*")
_TOPIC = re.compile(r"(/[A-Za-z][A-Za-z0-9_]*)+")
_CAMERA = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_RESERVED = ("frames", "tf", "tf_static", "robot_description", "camera", "language")
"""Reserved first words of topics."""
_DATASET = ("timestamp", "frame_index", "episode_index", "index", "task_index", "task", "next", "observation.images")
"""Column names of datasets."""


def read_episode_info(text: str, *, simulated: bool = True) -> EpisodeInfo:
    """Parse the description of an episode, by default only of a simulated one; ValueError in one line if invalid."""
    info = from_json(text, EpisodeInfo)
    if simulated and info.simulation is None:
        raise ValueError("it does not describe a simulated episode")
    if wrong := find_problems(info):
        raise ValueError("; ".join(wrong[:_MAX_LISTED]))
    return info


def find_problems(info: EpisodeInfo) -> list[str]:
    """List all problems that make a description invalid, in words; empty if it is valid."""
    own = list(_in_range("", info, "episode_index", "attempt", "fps"))
    if info.simulation is None:
        return [*own, *_external(info)]
    return [*own, *_simulation(info.simulation)] or list(_contradictions(info, info.simulation))


def _simulation(simulation: Simulation) -> Iterator[str]:
    robot, scene = simulation.robot, simulation.scene
    yield from _in_range("", simulation, "root_seed", "physics_hz")
    if not robot.arm_joints:
        yield "the robot has no arm joints"
    yield from _names("joints of the robot", robot.joint_names)
    yield from _scene(scene)
    placed = len(scene.robot.joint_position)
    if placed != len(robot.arm_joints):
        yield f"the robot has {len(robot.arm_joints)} arm joints, but the scene places {placed}"


def _contradictions(info: EpisodeInfo, simulation: Simulation) -> Iterator[str]:
    """Yield contradictions within the description of a valid simulation."""
    for feature in info.sensors.values():
        yield from _feature(feature, frozenset())
        yield from _sensor_stream(feature)
    yield from _names("features", [feature.name for feature in info.features])
    known = replace(with_simulation(info), robot_name=simulation.robot.name)
    is_known = all(feature in known.features for feature in info.features)  # in any order
    if not is_known or replace(known, features=info.features) != info:
        yield "the robot, the features or the cameras are not those of its scene"


def _scene(scene: Scene) -> Iterator[str]:
    known, movable = [body.name for body in scene.bodies], [body.name for body in scene.movable]
    if len(scene.bodies) > _MAX_BODIES:
        yield f"there are {len(scene.bodies)} bodies, the maximum is {_MAX_BODIES}"
    yield from _names("bodies", known)
    yield from _names("cameras", [camera.name for camera in scene.cameras])
    yield from _pose("world_from_base", scene.robot.world_from_base)
    yield from _in_range("the robot", scene.robot, "scale")
    yield from _in_range("the physics", scene.physics, "hz")
    for body in scene.bodies:
        yield from _body(body)
    for camera in scene.cameras:
        yield from _scene_camera(camera)
    for goal in scene.goals:
        yield from _pose("onto_from_goal", goal.onto_from_goal)
        yield from _in_range("a goal", goal, "yaw_symmetry")
        if goal.object not in movable:
            yield f"a goal is for {goal.object!r}, which is not a movable body of the scene"
        if goal.onto and goal.onto not in known:
            yield f"a goal is on {goal.onto!r}, which is not a body of the scene"


def _body(body: Body) -> Iterator[str]:
    what, shape = f"the body {body.name!r}", body.shape
    yield from _pose(what, body.world_from_body)
    yield from _in_range(what, body, "yaw_symmetry", "mass")
    yield from _in_range(f"the shape of {what}", shape, "scale")
    expected = _SIZE_LENGTH[shape.kind]
    if len(shape.size) != expected:
        yield f"the size of {what}, a {shape.kind}, has {len(shape.size)} numbers instead of {expected}"
    if not all(0 < value < 1e4 for value in shape.size):
        yield f"the size of {what} is {shape.size}"
    if shape.mesh:
        try:
            decode_mesh(shape.mesh)
        except SceneError as error:
            yield f"the mesh of {what}: {error}"


def _scene_camera(camera: SceneCamera) -> Iterator[str]:
    what = f"the camera {camera.name!r}"
    yield from _pose(what, camera.mount_from_camera)
    yield from _pixels(what, camera)
    yield from _in_range(what, camera, "fov_y")
    if not 0 < camera.near < camera.far:
        yield f"{what} sees from {camera.near:g} to {camera.far:g} m"


def _pixels(what: str, camera: Camera | SceneCamera) -> Iterator[str]:
    width, height = camera.width, camera.height
    if not (1 <= width <= 8192 and 1 <= height <= 8192 and width * height <= MAX_PIXELS):
        yield f"{what} has {width}x{height} pixels, allowed are 1 to {MAX_PIXELS} in all, and 8192 a side"


def _pose(what: str, pose: Pose) -> Iterator[str]:
    if not 0.5 < math.hypot(*pose.quat_xyzw.tolist()) < 2.0:  # `demorec check` judges the precision
        yield f"the rotation of {what} is invalid"


def _in_range(what: str, owner: object, *fields: str) -> Iterator[str]:
    for field in fields:
        value = getattr(owner, field)
        low, high = _RANGES[field]
        if not low <= value <= high:
            yield f"{field}{what and f' of {what}'} is {value}, allowed are {low:g} to {high:g}"


def _names(what: str, names: Iterable[str]) -> Iterator[str]:
    for name, count in Counter(names).items():
        if count > 1:
            yield f"{count} {what} are called {name!r}"
        if not name or not name.isprintable() or "," in name:
            yield f"one of the {what} is called {name!r}, allowed are printable characters without commas"


def _external(info: EpisodeInfo) -> Iterator[str]:
    if not info.instruction.strip():
        yield "the task text is empty"
    for what, text in (("task text", info.instruction), ("name of the robot", info.robot_name)):
        if len(text) > _MAX_TEXT or not text.isprintable():
            yield f"the {what} is not a single line of at most {_MAX_TEXT} characters"
    if not info.features:
        yield "there are no features"
    yield from _names("features", [feature.name for feature in info.features])
    yield from _names("cameras", [camera.name for camera in info.cameras])
    joints: frozenset[str] = frozenset()
    links: frozenset[str] = frozenset()
    if info.urdf:
        try:
            urdf = Urdf.parse(info.urdf)
        except ValueError as error:
            yield str(error)
        else:
            joints = frozenset(joint.name for joint in urdf.joints)
            links = frozenset((urdf.root, *(joint.child for joint in urdf.joints)))
    for feature in info.features:
        yield from _feature(feature, joints)
    for camera in info.cameras:
        yield from _external_camera(camera, links)


def _feature(feature: Feature, joints: frozenset[str]) -> Iterator[str]:
    name = feature.name
    if not _FEATURE.fullmatch(name):
        yield f"a feature is called {name!r}, allowed are words of letters, digits and _, with dots between them"
    if name.partition(".")[0] in _RESERVED or any(name == own or name.startswith(own + ".") for own in _DATASET):
        yield f"a feature is called {name!r}, which is a reserved name"
    count = len(feature.names)
    if not 1 <= count <= _MAX_ELEMENTS:
        yield f"the feature {name!r} has {count} elements, allowed are 1 to {_MAX_ELEMENTS}"
    yield from _names(f"elements of the feature {name!r}", feature.names)
    parts = (("units", feature.units), ("joints", feature.joints), ("calibrations", feature.calibration))
    for what, words in parts:
        if words and len(words) != count:
            yield f"the feature {name!r} has {count} elements, but {len(words)} {what}"
    named = list(filter(None, feature.joints))
    if unknown := [joint for joint in named if joints and joint not in joints]:
        yield f"the feature {name!r} has joints that the URDF lacks: {', '.join(unknown)}"
    yield from _names(f"joints of the feature {name!r}", named)


def _sensor_stream(feature: Feature) -> Iterator[str]:
    stream = feature.stream
    if feature.name.partition(".")[0] != "observation" or feature.dtype != "float64":
        yield f"the sensor {feature.name!r} is not an observation in float64"
    if stream is not None and stream.layout == "wrench" and len(feature.names) != 6:
        yield f"the wrench {feature.name!r} has {len(feature.names)} elements, it must have 6"
    if stream is not None and not _TOPIC.fullmatch(stream.topic):
        yield f"the topic of the sensor {feature.name!r} is {stream.topic!r}"


def _external_camera(camera: Camera, links: frozenset[str]) -> Iterator[str]:
    what = f"the camera {camera.name!r}"
    if not _CAMERA.fullmatch(camera.name):
        yield f"a camera is called {camera.name!r}, allowed are letters, digits and _, beginning with a letter"
    yield from _pixels(what, camera)
    if camera.intrinsics is not None and len(camera.intrinsics) != 9:
        yield f"{what} has {len(camera.intrinsics)} intrinsics, but K has 9"
    if links and camera.mount and camera.mount not in links:
        yield f"{what} is mounted on {camera.mount!r}, which is not a link of the URDF"
