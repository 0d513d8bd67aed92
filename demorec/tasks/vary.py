"""Task-independent application of the ranges of `demorec.episode.variation` to a scene."""

from __future__ import annotations

import colorsys
import math
from dataclasses import replace

import numpy as np

from demorec.core.geometry import Pose
from demorec.episode.scene import Body, Light, Rgba, Scene, SceneCamera, Shape, Texture, Vector3
from demorec.episode.variation import Ranges
from demorec.tasks.sampling import WORKSPACE, Region, Sampler
from demorec.tasks.script import Behaviour

NEUTRAL_COLORS: tuple[Rgba, ...] = (
    (0.15, 0.15, 0.16, 1.0),
    (0.55, 0.55, 0.56, 1.0),
    (0.92, 0.92, 0.90, 1.0),
    (0.42, 0.27, 0.16, 1.0),
    (0.93, 0.62, 0.70, 1.0),
)
"""Colours of distractors; instructions do not name them."""

DISTRACTOR_REGION = Region(x=(WORKSPACE.x[0] - 0.03, WORKSPACE.x[1] + 0.06), y=(-0.33, 0.33), max_radius=0.85)
DISTRACTOR_GAP = 0.12
"""Minimum distance between the middles of a distractor and of the task's objects, metres."""
DISTRACTOR_MARGIN = 0.045
"""Minimum distance from a distractor's middle to the outline of such an object (trays are large): half its diagonal and
1 cm."""


def draw_behaviour(ranges: Ranges, rng: np.random.Generator) -> Behaviour:
    """Draw the expert's behaviour in one episode."""
    names = ("speed", "approach_height", "lift_height", "grasp_offset", "action_noise")
    drawn = {name: ranges.draw(name, rng) for name in names}
    misses = float(rng.uniform()) < ranges.number("miss_probability")
    # To either side along the fingers' faces, up to 0.4 rad askew: across them a finger would come down on the object.
    distance, side = ranges.draw("miss_distance", rng), float(rng.uniform(-1.0, 1.0))
    askew = 0.8 * abs(side) - 0.4
    error_x, error_y, error_yaw = (float(v) for v in rng.normal(0.0, 1.0, 3))
    return Behaviour(
        **drawn,
        miss_x=math.copysign(distance * math.cos(askew), side) if misses else 0.0,
        miss_y=distance * math.sin(askew) if misses else 0.0,
        perception_x=error_x * ranges.number("perception_error"),
        perception_y=error_y * ranges.number("perception_error"),
        perception_yaw=error_yaw * ranges.number("perception_yaw"),
    )


def vary_physics(scene: Scene, ranges: Ranges, rng: np.random.Generator, *, distractors: bool = True) -> Scene:
    """Vary masses, friction, damping, gravity, table height and, unless the scene has its own, distractors.

    Raises:
        SceneError: The distractors do not fit.
    """
    bodies = []
    for body in scene.bodies:
        if body.movable:
            mass, friction = body.mass * ranges.draw("mass_factor", rng), ranges.draw("friction_factor", rng)
            damping = ranges.draw("damping", rng)
            body = replace(body, mass=mass, lateral_friction=body.lateral_friction * friction)
            body = replace(body, linear_damping=damping, angular_damping=damping)
        bodies.append(body)
    x, y, z = scene.physics.gravity
    physics = replace(scene.physics, gravity=(x, y, z + ranges.draw("gravity_offset", rng)))
    scene = replace(scene, bodies=tuple(bodies), physics=physics)
    scene = _lower_table(scene, -ranges.draw("table_height", rng))
    low, high = ranges.range("distractors") if distractors else (0, 0)
    return _with_distractors(scene, int(rng.integers(int(low), int(high) + 1)), rng)


def _lower_table(scene: Scene, drop: float) -> Scene:
    """Put the robot on a pedestal of this height: the world's z = 0 stays on the table."""
    if drop == 0.0:
        return scene
    base = scene.robot.world_from_base
    raised = Pose(position=base.position + np.array([0.0, 0.0, drop]), quat_xyzw=base.quat_xyzw)
    pedestal = Body(
        name="pedestal",
        role="fixture",
        shape=Shape(kind="box", size=(0.24, 0.24, drop)),
        world_from_body=Pose(position=base.position + np.array([-0.03, 0.0, drop / 2])),
        rgba=(0.3, 0.3, 0.32, 1.0),
    )
    return replace(scene, robot=replace(scene.robot, world_from_base=raised), bodies=(pedestal, *scene.bodies))


def _with_distractors(scene: Scene, count: int, rng: np.random.Generator) -> Scene:
    sampler = Sampler(rng)
    others = [body for body in scene.bodies if body.role in ("object", "target", "distractor")]
    poses = [*(body.world_from_body for body in others), *(scene.world_from_goal(goal) for goal in scene.goals)]
    taken = [(float(pose.position[0]), float(pose.position[1])) for pose in poses]
    bodies = list(scene.bodies)
    for index in range(count):
        point = sampler.point(
            DISTRACTOR_REGION,
            away_from=taken,
            min_distance=DISTRACTOR_GAP,
            accept=lambda point: all(_from_outline(body, point) >= DISTRACTOR_MARGIN for body in others),
            what="a distractor",
        )
        taken.append(point)
        bodies.append(_distractor(f"distractor_{index}", point, sampler))
    return replace(scene, bodies=tuple(bodies))


def _from_outline(body: Body, point: tuple[float, float]) -> float:
    """Compute the distance, metres, from a body's bounding rectangle, seen from above, to a point; 0 within it."""
    x, y, _ = body.world_from_body.inverse().apply(np.array([*point, 0.0]))
    width, depth, _ = body.shape.extents
    return math.hypot(max(0.0, abs(x) - width / 2), max(0.0, abs(y) - depth / 2))


def _distractor(name: str, point: tuple[float, float], sampler: Sampler) -> Body:
    shape = sampler.choice(
        [
            Shape(kind="box", size=tuple(sampler.uniform(0.02, 0.05) for _ in range(3))),
            Shape(kind="cylinder", size=(sampler.uniform(0.012, 0.025), sampler.uniform(0.02, 0.05))),
        ]
    )
    return Body(
        name=name,
        role="distractor",
        shape=shape,
        world_from_body=Pose.from_yaw((*point, shape.extents[2] / 2 + 5e-4), sampler.uniform(-math.pi, math.pi)),
        mass=0.1,
        rgba=sampler.choice(NEUTRAL_COLORS),
        # A touched cylinder must not keep rolling for the rest of the episode.
        rolling_friction=0.001,
        yaw_symmetry=2 if shape.kind == "box" else 0,
    )


def vary_looks(scene: Scene, ranges: Ranges, rng: np.random.Generator) -> Scene:
    """Vary light, colours and textures; nothing that affects physics."""
    bodies = []
    for body in scene.bodies:
        if body.color_name and body.rgba != (1.0, 1.0, 1.0, 1.0):
            shade = 1.0 + ranges.number("object_shade") * float(rng.uniform(-1.0, 1.0))
            red, green, blue, alpha = body.rgba
            body = replace(body, rgba=(min(1.0, shade * red), min(1.0, shade * green), min(1.0, shade * blue), alpha))
        elif body.name in ("table", "floor") or body.name.startswith("wall"):
            body = _other_surface(body, ranges, rng)
        bodies.append(body)
    return replace(scene, bodies=tuple(bodies), light=_other_light(scene.light, ranges, rng))


def _other_surface(body: Body, ranges: Ranges, rng: np.random.Generator) -> Body:
    """Draw a muted colour or texture: the named colours remain the only saturated ones."""
    amount = ranges.number("surface_color")
    muted = colorsys.hsv_to_rgb(*(float(rng.uniform(*pair)) for pair in ((0.0, 1.0), (0.0, 0.25), (0.3, 0.9))))
    other = colorsys.hsv_to_rgb(*(float(rng.uniform(*pair)) for pair in ((0.05, 0.12), (0.1, 0.45), (0.3, 0.9))))
    red, green, blue = (own + amount * (new - own) for own, new in zip(body.rgba[:3], muted, strict=True))
    textured = float(rng.uniform()) < ranges.number("texture_probability")
    pattern = ("checker", "stripes", "noise", "wood")[int(rng.integers(4))]
    scale, seed = float(rng.integers(4, 17)), int(rng.integers(2**31))
    if not textured:
        return replace(body, rgba=(red, green, blue, body.rgba[3]))
    texture = Texture(pattern=pattern, colors=((red, green, blue), other), scale=scale, seed=seed)  # type: ignore[arg-type]
    return replace(body, rgba=(1.0, 1.0, 1.0, 1.0), texture=texture)


def _other_light(light: Light, ranges: Ranges, rng: np.random.Generator) -> Light:
    turn, elevation = ranges.draw("light_turn", rng), ranges.draw("light_elevation", rng)
    strengths = {name: ranges.draw(f"light_{name}", rng) for name in ("ambient", "diffuse", "shadow")}
    warmth, brightness = ranges.draw("light_warmth", rng), ranges.draw("sky_brightness", rng)
    azimuth = math.atan2(light.direction[1], light.direction[0]) + turn
    flat = math.cos(elevation)
    sky: Vector3 = tuple(min(1.0, brightness * channel) for channel in light.sky_color)  # type: ignore[assignment]
    return replace(
        light,
        direction=(flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)),
        **strengths,
        color=(1.0 + min(0.0, 0.15 * warmth), 1.0 - 0.04 * abs(warmth), 1.0 - max(0.0, 0.2 * warmth)),
        sky_color=sky,
    )


def vary_cameras(cameras: tuple[SceneCamera, ...], ranges: Ranges, rng: np.random.Generator) -> tuple[SceneCamera, ...]:
    """Perturb the nominal camera poses; the result is recorded as their pose."""
    nudged = []
    for camera in cameras:
        nudge = small_pose(rng, position=ranges.number("camera_position"), rotation=ranges.number("camera_rotation"))
        zoom = 1.0 + ranges.number("camera_fov") * float(rng.uniform(-1.0, 1.0))
        nudged.append(replace(moved_camera(camera, nudge), fov_y=camera.fov_y * zoom))
    return tuple(nudged)


def moved_camera(camera: SceneCamera, by: Pose) -> SceneCamera:
    """Move a camera along and about its own axes; bit-exact if the displacement is zero."""
    return camera if by == Pose() else replace(camera, mount_from_camera=camera.mount_from_camera @ by)


def calibration_errors(cameras: tuple[SceneCamera, ...], ranges: Ranges, rng: np.random.Generator) -> dict[str, Pose]:
    """Draw camera name -> true_from_recorded: the error of the recorded extrinsics."""
    position, rotation = ranges.number("calibration_position"), ranges.number("calibration_rotation")
    return {camera.name: small_pose(rng, position=position, rotation=rotation) for camera in cameras}


def small_pose(rng: np.random.Generator, *, position: float, rotation: float) -> Pose:
    """Draw a small transform: up to `position` m and about `rotation` rad along and about each axis."""
    offset = position * rng.uniform(-1.0, 1.0, 3)
    half = 0.5 * rotation * rng.uniform(-1.0, 1.0, 3)
    length = math.sqrt(1.0 + sum(float(v) * float(v) for v in half))
    return Pose(position=offset, quat_xyzw=np.array([*(half / length), 1.0 / length]))
