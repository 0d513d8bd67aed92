"""Placing of a named object from an object set onto a mark or a plate, or into a tray or a bowl."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from demorec.core.errors import SceneError
from demorec.core.geometry import Pose
from demorec.episode.mesh import decode_mesh, encode_mesh
from demorec.episode.scene import Body, Goal, Rgba, Role, Scene, Shape, Texture
from demorec.episode.words import VESSELS
from demorec.extensions.tasks.pick import IN_TRAY, OTHER_COLORS, TRAY_FLOOR, TRAYS, tray
from demorec.extensions.tasks.solid_physics import ROLLING_FRICTION, at_rest, with_parts
from demorec.extensions.tasks.solids import dish
from demorec.objects.shelf import MATERIALS, Kind, Material
from demorec.robots.robot import RobotSpec
from demorec.tasks.base import Layout, TableTask
from demorec.tasks.furniture import COLORS, TABLE_HEIGHT, green_target, words_for
from demorec.tasks.grasping import found_grasps
from demorec.tasks.sampling import WORKSPACE, Region, Sampler, wording

WALL_HEIGHT = 1.6
"""Height of the walls around the table, metres; the sun of `--variation full` is above them."""
BESIDE_TRAY = Region(x=(0.33, 0.68), y=(-0.30, 0.15))
EVERYWHERE = Region(x=(0.33, 0.68), y=(-0.30, 0.30))
HAND = 0.105
"""Radius, metres, kept free around a grasp or a placement for the palm and the fingers."""
GAP = 0.02
"""Minimum gap between objects that are not moved, metres."""
MOST_THINGS = 6
MASSES = (0.01, 0.2)
"""Range of masses, kg: lighter objects need too many solver iterations (see `_PUSH`), heavier ones slip."""
_PUSH = 200.0
"""Maximum acceleration, m/s^2, from one finger's force at which 50 solver iterations suffice to balance two fingers;
higher ones need proportionally more. With 50, fingers penetrated vases of 40 g by up to 2.7 mm; with enough, by 0.7
(0.2 is due to the fingers' stiffness)."""
TINTS = (0.6, 0.85)
"""Range of factors from an object's colour to the darker colour of its texture."""
DRAWS = 50
"""Maximum attempts to draw an object that rests on a table and can be grasped."""
NEUTRAL_COLORS: Mapping[str, Rgba] = {"grey": (0.5, 0.5, 0.51, 1.0), "black": (0.15, 0.15, 0.16, 1.0)}
"""Colours of distractors; instructions do not name them."""
DISHES = {"bowl": (0.085, 0.115, 0.03), "plate": (0.08, 0.105, 0.012)}
"""Round white fixed vessels: radii of the flat floor and of the rim, and height of the rim, metres."""
DISH_FLOOR = 0.004
"""Height of a dish's floor above its lower face, metres."""
BESIDE_THING = 0.015
"""Width of a dish's floor left free around an object at its middle, metres."""


class PickAnything(TableTask):
    """Pick up the named object and place it on the mark or the plate, or in the tray or the bowl.

    Task: one to six objects from object sets (`--objects`), each with a different name or colour; a square mark, or a
        tray, bowl or plate on the robot's left. `--distractors` adds grey or black objects from the same sets.
    Randomised: objects and their shapes (`--object-split`), positions, yaws, colours, densities and frictions by
        material; type, position and yaw of the target; the arm's initial joints.
    Success: the object's centre within 2 cm of the mark's, or in the tray, bowl or plate, on its floor, tilted by less
        than 5 degrees from its initial orientation, at rest, not touched; everything else within 2 cm of its initial
        position; the gripper open.
    """

    summary = "the named thing out of one to six, to a mark, a tray, a bowl or a plate"
    draws_distractors = True
    shelves = ("household", "blocks")
    wordings = (
        "pick up the {thing} and put it {place}",
        "put the {thing} {place}",
        "find the {thing} and place it {place}",
    )

    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout."""

        def can_grasp(shape: Shape) -> bool:
            shape = replace(shape, scale=robot.task_scale * shape.scale)
            return bool(found_grasps(shape, robot, np.array([0.0, 0.0, 1.0])))

        sampler.can_grasp = can_grasp
        scene = super().sample_scene(robot, sampler)
        wanted = scene.body(scene.goals[0].object)
        force = float(robot.gripper.contact_force(np.array(min(wanted.shape.extents)))) / 2
        times = max(1.0, force / wanted.mass / _PUSH)
        physics = replace(scene.physics, grip_iterations=round(times * scene.physics.solver_iterations))
        return replace(scene, bodies=(*scene.bodies, *walls()), physics=physics)

    def layout(self, sampler: Sampler) -> Layout:
        """Draw objects and goal."""
        things = _things(sampler, 1 + int(sampler.rng.integers(MOST_THINGS)))
        low, high = sampler.ranges.range("distractors")
        things += _things(sampler, int(sampler.rng.integers(int(low), int(high) + 1)), neutral=True)
        onto = sampler.choice(_targets(things[0]))
        start = sampler.point(WORKSPACE if onto == "mark" else BESIDE_TRAY, what="the wanted thing")
        wanted = _standing(things[0], start, sampler.yaw())
        room = max(HAND, radius_of(wanted) + GAP)
        taken = [(start, room)]
        if onto == "mark":
            target, goal = _mark_and_goal(sampler, wanted, start)
            x, y, _ = goal.onto_from_goal.position.tolist()
            taken.append(((x, y), room))
        else:
            target, goal = _container_and_goal(sampler, wanted, onto)
        others: list[Body] = []
        for thing in things[1:]:
            radius = radius_of(thing)
            try:
                point = sampler.point(
                    EVERYWHERE if onto == "mark" else BESIDE_TRAY,
                    accept=lambda point, radius=radius: all(math.dist(point, at) > r + radius for at, r in taken),  # type: ignore[misc]
                    what="another thing",
                )
            except SceneError:  # the table is full
                break
            taken.append((point, radius + GAP))
            others.append(_standing(thing, point, sampler.yaw(), role="distractor"))
        return [target, wanted, *others], [goal]

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """Fill in one of the wordings."""
        (goal,) = scene.goals
        name = goal.onto or "green_target"
        place = f"{'in' if name.endswith(VESSELS) else 'on'} the {name.replace('_', ' ')}"
        return wording(rng, *self.wordings, thing=words_for(scene.body(goal.object)), place=place)


def walls() -> tuple[Body, ...]:
    """Make visual-only walls behind the table and on both sides, out of the arm's reach; named "wall..."."""
    places = {
        "wall_back": (-1.3, 0.0, 0.0),
        "wall_left": (0.7, 1.5, -math.pi / 2),
        "wall_right": (0.7, -1.5, math.pi / 2),
    }
    return tuple(
        Body(
            name=name,
            role="fixture",
            shape=Shape(kind="box", size=(0.02, 4.0, WALL_HEIGHT)),
            world_from_body=Pose.from_yaw((x, y, WALL_HEIGHT / 2 - TABLE_HEIGHT), yaw),
            rgba=(0.70, 0.74, 0.76, 1.0),
            collides=False,
        )
        for name, (x, y, yaw) in places.items()
    )


def radius_of(body: Body) -> float:
    """Compute the radius, metres, of the circle about a body's origin, seen from above, that contains it."""
    points = decode_mesh(body.shape.mesh).points
    return body.shape.scale * math.sqrt(float((points[:, :2] ** 2).sum(axis=1).max()))


def _targets(wanted: Body) -> list[str]:
    """List the possible targets of an object: it must fit on the flat floor of a dish."""
    room = radius_of(wanted) + BESIDE_THING
    return ["mark", "mark", "tray", *(name for name, (floor, *_) in DISHES.items() if room < floor)]


def _things(sampler: Sampler, count: int, *, neutral: bool = False) -> list[Body]:
    """Draw up to `count` objects at the origin, each with a different name or colour; fewer if the sets have no more.

    The first one can be grasped; SceneError if none can. Neutral ones are grey or black and need not be graspable.
    """
    kinds = [kind for shelf in sampler.shelves for kind in shelf.kinds if kind.numbers(sampler.object_split)]
    if not kinds:
        raise SceneError(f"The object sets have no shape for --object-split {sampler.object_split}: choose another.")
    left = [(kind, color) for kind in kinds for color in (NEUTRAL_COLORS if neutral else kind.colors or OTHER_COLORS)]
    things: dict[str, Body] = {}
    for _ in range(DRAWS * count):
        if not left or len(things) == count:
            break
        kind = sampler.choice(list({kind.noun: kind for kind, _ in left}.values()))
        color = sampler.choice([color for other, color in left if other.noun == kind.noun])
        try:
            thing = make_object(sampler, kind, sampler.choice(kind.numbers(sampler.object_split)), color)
        except SceneError:  # it does not come to rest
            continue
        if neutral or things or sampler.can_grasp(thing.shape):
            left = [entry for entry in left if (entry[0].noun, entry[1]) != (kind.noun, color)]
            things[thing.name] = thing
    if not things and not neutral:
        raise SceneError("The gripper cannot grasp any object of these sets: choose others with --objects.")
    return list(things.values())


_ALL_COLORS = {**COLORS, **NEUTRAL_COLORS}


def make_object(sampler: Sampler, kind: Kind, number: int, color_name: str) -> Body:
    """Make an object in its resting pose at the world's origin, with density and friction of its material."""
    material = MATERIALS[kind.material]
    mesh, height = at_rest(encode_mesh(with_parts(kind.shape(number))))
    solid = decode_mesh(mesh)
    x, y, z = solid.extents.tolist()
    mass = sampler.uniform(*material.density) * solid.mass_properties()[0]
    return Body(
        name=f"{color_name}_{kind.noun}",
        role="object",
        shape=Shape(kind="mesh", size=(x, y, z), mesh=mesh),
        world_from_body=Pose(position=np.array([0.0, 0.0, height])),
        mass=min(max(mass, MASSES[0]), MASSES[1]),
        lateral_friction=sampler.uniform(*material.friction),
        rolling_friction=ROLLING_FRICTION,
        rgba=_ALL_COLORS[color_name],
        color_name=color_name,
        yaw_symmetry=kind.yaw_symmetry,
        texture=_texture(sampler, material),
    )


def _texture(sampler: Sampler, material: Material) -> Texture | None:
    """Draw a texture in tints of the object's colour, so that its colour word stays true; None for a plain surface."""
    pattern, tint = sampler.choice(material.patterns), sampler.uniform(*TINTS)
    if pattern == "plain":
        return None
    return Texture(
        pattern=pattern,
        colors=((1.0, 1.0, 1.0), (tint, tint, tint)),
        scale=float(sampler.rng.integers(4, 13)),
        seed=int(sampler.rng.integers(2**31)),
    )


def _standing(thing: Body, point: tuple[float, float], yaw: float, role: Role = "object") -> Body:
    """Place an object half a millimetre above the table at a point and yaw."""
    height = float(thing.world_from_body.position[2]) + 5e-4
    return replace(thing, role=role, world_from_body=Pose.from_yaw((*point, height), yaw))


def _resting(thing: Body, point: Sequence[float], floor: float = 0.0) -> Pose:
    """Compute the pose of an upright object that rests on a floor."""
    return Pose.from_yaw((point[0], point[1], floor + float(thing.world_from_body.position[2]) - 5e-4), 0.0)


def _mark_and_goal(sampler: Sampler, wanted: Body, start: tuple[float, float]) -> tuple[Body, Goal]:
    place = sampler.point(WORKSPACE, away_from=[start], min_distance=0.16, what="the target")
    target = green_target(place, sampler.yaw(), side=0.10)
    return target, Goal(object=wanted.name, onto="", onto_from_goal=_resting(wanted, place), yaw_symmetry=0)


def _container_and_goal(sampler: Sampler, wanted: Body, onto: str) -> tuple[Body, Goal]:
    point, yaw = sampler.point(TRAYS, what=f"the {onto}"), sampler.uniform(-0.25, 0.25)
    if onto == "tray":
        target, floor, area = tray("blue_tray", point, yaw, color_name="blue"), TRAY_FLOOR, IN_TRAY
    else:
        half = DISHES[onto][0] / math.sqrt(2)  # side of the largest square within the round floor
        target, floor, area = _dish_body(onto, point, yaw), DISH_FLOOR, (-half, -half, half, half)
    pose = _resting(wanted, (0.0, 0.0), floor)
    return target, Goal(object=wanted.name, onto=target.name, onto_from_goal=pose, yaw_symmetry=0, area=area)


def _dish_body(noun: str, point: tuple[float, float], yaw: float) -> Body:
    """Make a white bowl or plate, its origin in its lower face."""
    mesh = dish(*DISHES[noun], thickness=DISH_FLOOR)
    x, y, z = mesh.extents.tolist()
    return Body(
        name=f"white_{noun}",
        role="target",
        shape=Shape(kind="mesh", size=(x, y, z), mesh=encode_mesh(mesh)),
        world_from_body=Pose.from_yaw((*point, 0.0005), yaw),
        lateral_friction=0.6,
        rgba=(0.93, 0.92, 0.88, 1.0),
        color_name="white",
        yaw_symmetry=0,
    )
