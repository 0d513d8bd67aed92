"""Validity of an episode's description, read from a file or just made.

`demorec.core.plain` has already checked types; this module checks further assumptions of the program: positive sizes,
unique names, valid references. `demorec check` judges whether the numbers are *plausible*.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator

from demorec.core.config import MAX_PIXELS
from demorec.core.errors import SceneError
from demorec.core.geometry import Pose
from demorec.core.plain import from_json
from demorec.episode.info import Camera, EpisodeInfo, Feature, Simulation
from demorec.episode.mesh import decode_mesh
from demorec.episode.scene import Body, Scene, SceneCamera, Shape
from demorec.episode.simulated import simulated_cameras, simulated_features
from demorec.robots.robot import RobotSpec
from demorec.robots.urdf import Urdf

_MOST = {"bodies": 255, "goals": 255, "cameras": 64, "arm joints": 64, "gripper joints": 64}
"""Maximum counts. Segmentation images distinguish 255 bodies; the others are far beyond any known scene."""
_SIZE_LENGTH = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "mesh": 3, "urdf": 3}
_MAX_METRES = 1e4
_MAX_LISTED = 5


def read_episode_info(text: str, *, simulated: bool = True) -> EpisodeInfo:
    """Parse the description of an episode from its JSON.

    Args:
        text: JSON text.
        simulated: Whether only a simulated episode is accepted.

    Raises:
        ValueError: One line with the reason.
    """
    info = from_json(text, EpisodeInfo)
    if simulated and info.simulation is None:
        raise ValueError("it does not describe a simulated episode")
    wrong = find_problems(info)
    if wrong:
        raise ValueError("; ".join(wrong[:_MAX_LISTED]))
    return info


def _episode(info: EpisodeInfo, simulation: Simulation) -> Iterator[str]:
    robot, scene = simulation.robot, simulation.scene
    yield from _within("episode_index", info.episode_index, 0, 2**63 - 1)
    yield from _within("attempt", info.attempt, 0, 2**31)
    yield from _within("root_seed", simulation.root_seed, 0, 2**63 - 1)
    yield from _within("fps", info.fps, 1, 10_000)
    yield from _within("physics_hz", simulation.physics_hz, 1, 100_000)
    yield from _robot(robot)
    yield from _scene(scene)
    placed = len(scene.robot.joint_position)
    if placed != len(robot.arm_joints):
        yield f"the robot has {len(robot.arm_joints)} arm joints, but the scene places {placed}"


def _contradictions(info: EpisodeInfo, simulation: Simulation) -> Iterator[str]:
    """Yield contradictions within the description of a valid simulation."""
    if info.robot_name != simulation.robot.name:
        yield f"the robot is {info.robot_name!r} and {simulation.robot.name!r}"
    known = simulated_features(simulation, list(info.sensors.values()))
    for feature in info.sensors.values():
        yield from _feature(feature, frozenset())
        yield from _sensor_stream(feature)
    if unknown := [feature.name for feature in info.features if feature not in known]:
        yield f"the features {', '.join(unknown)} are not those of its robot"
    yield from _unique("features", [feature.name for feature in info.features])
    if info.cameras != simulated_cameras(simulation.scene):
        yield "the cameras are not those of the scene"


def _robot(robot: RobotSpec) -> Iterator[str]:
    yield from _count("arm joints", robot.arm_joints, least=1)
    yield from _count("gripper joints", robot.gripper.joints, least=0)
    yield from _unique("joints of the robot", robot.joint_names)
    for name in ("home_q", "position_lower", "position_upper", "velocity_limit", "acceleration_limit", "torque_limit"):
        values: tuple[float, ...] = getattr(robot, name)
        if len(values) != len(robot.arm_joints):
            yield f"{name} of the robot has {len(values)} numbers for {len(robot.arm_joints)} arm joints"
        if name.endswith("_limit") and not all(value > 0 for value in values):
            yield f"{name} of the robot is not positive"


def _scene(scene: Scene) -> Iterator[str]:
    yield from _count("bodies", scene.bodies, least=0)
    yield from _count("goals", scene.goals, least=0)
    yield from _count("cameras", scene.cameras, least=0)
    yield from _unique("bodies", [body.name for body in scene.bodies])
    yield from _unique("cameras", [camera.name for camera in scene.cameras])
    yield from _pose("world_from_base", scene.robot.world_from_base)
    yield from _positive("scale of the robot", scene.robot.scale)
    yield from _within("hz of the physics", scene.physics.hz, 1, 100_000)
    yield from _within("solver_iterations", scene.physics.solver_iterations, 1, 10_000)
    yield from _within("grip_iterations", scene.physics.grip_iterations, 0, 10_000)
    yield from _positive("contact_breaking_threshold", scene.physics.contact_breaking_threshold)
    yield from _within("finger_stiffness", scene.physics.finger_stiffness, 1, 1e9)
    for body in scene.bodies:
        yield from _body(body)
    for camera in scene.cameras:
        yield from _camera(camera)
    movable = {body.name for body in scene.movable}
    known = {body.name for body in scene.bodies}
    for goal in scene.goals:
        yield from _pose("onto_from_goal", goal.onto_from_goal)
        yield from _within("yaw_symmetry of a goal", goal.yaw_symmetry, 0, 360)
        if goal.area is not None:
            least_x, least_y, most_x, most_y = goal.area
            if not (least_x <= most_x and least_y <= most_y and max(map(abs, goal.area)) <= _MAX_METRES):
                yield f"the area of a goal is from ({least_x}, {least_y}) to ({most_x}, {most_y})"
        if goal.object not in movable:
            yield f"a goal is for {goal.object!r}, which is not a movable body of the scene"
        if goal.onto and goal.onto not in known:
            yield f"a goal is on {goal.onto!r}, which is not a body of the scene"


def _body(body: Body) -> Iterator[str]:
    what = f"the body {body.name!r}"
    yield from _pose(what, body.world_from_body)
    yield from _shape(what, body.shape)
    yield from _within(f"yaw_symmetry of {what}", body.yaw_symmetry, 0, 360)
    yield from _within(f"mass of {what}", body.mass, 0, 1e6)
    colors = [body.rgba, *(body.texture.colors if body.texture is not None else ())]
    if not all(0 <= part <= 1 for color in colors for part in color):
        yield f"a colour of {what} is outside 0 to 1"
    if body.texture is not None:
        yield from _within(f"texture scale of {what}", body.texture.scale, 1e-3, 1e4)
        yield from _within(f"texture seed of {what}", body.texture.seed, 0, 2**63 - 1)


def _shape(what: str, shape: Shape) -> Iterator[str]:
    expected = _SIZE_LENGTH[shape.kind]
    if len(shape.size) != expected:
        yield f"the size of {what}, a {shape.kind}, has {len(shape.size)} numbers instead of {expected}"
    for value in (*shape.size, shape.scale):
        yield from _positive(f"a size of {what}", value)
    if max(map(abs, shape.origin)) > _MAX_METRES:
        yield f"the origin of {what} is far away"
    if shape.mesh:
        try:
            decode_mesh(shape.mesh)
        except SceneError as error:
            yield f"the mesh of {what}: {error}"


def _camera(camera: SceneCamera) -> Iterator[str]:
    what = f"the camera {camera.name!r}"
    yield from _pose(what, camera.mount_from_camera)
    yield from _pixels(what, camera)
    if not 1e-3 <= camera.fov_y <= math.pi - 1e-3:
        yield f"fov_y of {what} is {camera.fov_y:g}, it must be between 0 and pi"
    if not 0 < camera.near < camera.far:
        yield f"{what} sees from {camera.near:g} to {camera.far:g} m"


def _pixels(what: str, camera: Camera | SceneCamera) -> Iterator[str]:
    width, height = camera.width, camera.height
    if not (1 <= width <= 8192 and 1 <= height <= 8192 and width * height <= MAX_PIXELS):
        yield f"{what} has {width}x{height} pixels, allowed are 1 to {MAX_PIXELS} in all, and 8192 a side"


def _pose(what: str, pose: Pose) -> Iterator[str]:
    if float(abs(pose.position).max()) > _MAX_METRES:
        yield f"the position of {what} is far away"
    if not 0.5 < math.hypot(*pose.quat_xyzw.tolist()) < 2.0:  # `demorec check` judges the precision
        yield f"the rotation of {what} is invalid"


def _positive(what: str, value: float) -> Iterator[str]:
    if not 0 < value <= _MAX_METRES:
        yield f"{what} is {value:g}"


def _within(what: str, value: float, low: float, high: float) -> Iterator[str]:
    if not low <= value <= high:
        yield f"{what} is {value}, allowed are {low} to {high}"


def _count(what: str, items: Iterable[object], *, least: int) -> Iterator[str]:
    yield from _within(f"the number of {what}", len(tuple(items)), least, _MOST[what])


def _unique(what: str, names: Iterable[str], *, commas: bool = True) -> Iterator[str]:
    allowed = "" if commas else ", allowed are printable characters without commas"
    for name, count in Counter(names).items():
        if count > 1:
            yield f"{count} {what} are called {name!r}"
        if not name or not name.isprintable() or (not commas and "," in name):
            yield f"one of the {what} is called {name!r}{allowed}"


_FEATURE = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z][A-Za-z0-9_]*)*")
_TOPIC = re.compile(r"(/[A-Za-z][A-Za-z0-9_]*)+")
_CAMERA = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_RESERVED = ("frames", "tf", "tf_static", "robot_description", "camera", "language")
"""Reserved first words of topics."""
_DATASET = ("timestamp", "frame_index", "episode_index", "index", "task_index", "task", "next", "observation.images")
"""Column names of datasets."""
_MAX_ELEMENTS = 4096
_MAX_FEATURES = 256
_MAX_CAMERAS = 64
_MAX_TEXT = 10_000


def find_problems(info: EpisodeInfo) -> list[str]:
    """List all problems that make a description invalid, in words; empty if it is valid."""
    if info.simulation is None:
        return list(_external(info))
    return list(_episode(info, info.simulation)) or list(_contradictions(info, info.simulation))


def _external(info: EpisodeInfo) -> Iterator[str]:
    yield from _within("episode_index", info.episode_index, 0, 2**31 - 1)
    yield from _within("fps", info.fps, 1, 10_000)
    if not info.instruction.strip():
        yield "the task text is empty"
    for what, text in (("task text", info.instruction), ("name of the robot", info.robot_name)):
        if len(text) > _MAX_TEXT or not text.isprintable():
            yield f"the {what} is not a single line of at most {_MAX_TEXT} characters"
    if not 1 <= len(info.features) <= _MAX_FEATURES or len(info.cameras) > _MAX_CAMERAS:
        yield (
            f"there are {len(info.features)} features and {len(info.cameras)} cameras, allowed are 1 to {_MAX_FEATURES}"
            f" and up to {_MAX_CAMERAS}"
        )
    yield from _unique("features", [feature.name for feature in info.features], commas=False)
    yield from _unique("cameras", [camera.name for camera in info.cameras], commas=False)
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
    yield from _unique(f"elements of the feature {name!r}", feature.names, commas=False)
    parts = (("units", feature.units), ("joints", feature.joints), ("calibrations", feature.calibration))
    for what, words in parts:
        if words and len(words) != count:
            yield f"the feature {name!r} has {count} elements, but {len(words)} {what}"
    named = list(filter(None, feature.joints))
    if unknown := [joint for joint in named if joints and joint not in joints]:
        yield f"the feature {name!r} has joints that the URDF lacks: {', '.join(unknown)}"
    yield from _unique(f"joints of the feature {name!r}", named, commas=False)


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
