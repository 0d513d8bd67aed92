"""A named thing out of several from a shelf goes onto a mark or into a tray."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from demorec.core.errors import SceneError
from demorec.core.geometry import Pose
from demorec.episode.mesh import decode_mesh, encode_mesh
from demorec.episode.scene import Body, Goal, Role, Scene, Shape
from demorec.objects.shelf import MATERIALS, Kind
from demorec.robots.robot import RobotSpec
from demorec.sim.parts import with_parts
from demorec.sim.resting import ROLLING_FRICTION, at_rest
from demorec.tasks.furniture import COLORS, mark, words_for
from demorec.tasks.grasping import found_grasps
from demorec.tasks.placing import Layout, TableTask
from demorec.tasks.sampling import WORKSPACE, Region, Sampler, wording
from demorec.tasks.trays import TRAY_FLOOR, TRAYS, tray

BESIDE_TRAY = Region(x=(0.33, 0.68), y=(-0.30, 0.15))
EVERYWHERE = Region(x=(0.33, 0.68), y=(-0.30, 0.30))
HAND = 0.105
"""Room, metres, about the middle of what is grasped or put down, for the palm and the fingers."""
GAP = 0.02
"""Between things that stay where they are, metres."""
MOST_THINGS = 6
MASSES = (0.015, 0.2)
"""Limits, kg: lighter things jump, heavier ones slip."""


class PickAnything(TableTask):
    """Pick up the named thing and put it onto the mark or into the tray.

    Task: one to six things from shelves (`--objects`), each of another name or colour; a square mark, or a tray at the
        robot's left.
    Randomised: which things and their shapes (`--object-split`), places, yaws, colours, densities and frictions by
        material; mark or tray, its place and yaw; where in the tray (3 cm about its middle); the arm's initial joints.
    Success: the thing's centre within 2 cm of the mark's, or of its place in the tray, standing as it stood within
        5 degrees, at rest, not touched; everything else within 2 cm of where it was; the gripper open.
    """

    summary = "the named thing out of one to six, to a mark or into a tray"
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
        return super().sample_scene(robot, sampler)

    def layout(self, sampler: Sampler) -> Layout:
        """Draw it."""
        into_tray = sampler.uniform(0.0, 1.0) < 0.5
        region = BESIDE_TRAY if into_tray else EVERYWHERE
        things = _things(sampler, 1 + int(sampler.rng.integers(MOST_THINGS)))
        start = sampler.point(BESIDE_TRAY if into_tray else WORKSPACE, what="the wanted thing")
        wanted = _standing(things[0], start, sampler.yaw())
        room = max(HAND, radius_of(wanted) + GAP)
        taken = [(start, room)]
        target, goal = _tray_and_goal(sampler, wanted) if into_tray else _mark_and_goal(sampler, wanted, start)
        if not into_tray:
            x, y, _ = goal.onto_from_goal.position.tolist()
            taken.append(((x, y), room))
        others: list[Body] = []
        for thing in things[1:]:
            radius = radius_of(thing)
            point = sampler.point(
                region,
                accept=lambda point, radius=radius: all(math.dist(point, at) > r + radius for at, r in taken),  # type: ignore[misc]
                what="another thing",
            )
            taken.append((point, radius + GAP))
            others.append(_standing(thing, point, sampler.yaw(), role="distractor"))
        return [target, wanted, *others], [goal]

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """One of the wordings, filled in."""
        (goal,) = scene.goals
        place = f"in the {scene.body(goal.onto).color_name} tray" if goal.onto else "on the green target"
        return wording(rng, *self.wordings, thing=words_for(scene.body(goal.object)), place=place)


def radius_of(body: Body) -> float:
    """Of the circle about a body's origin, seen from above, that holds it, metres."""
    points = decode_mesh(body.shape.mesh).points
    return body.shape.scale * math.sqrt(float((points[:, :2] ** 2).sum(axis=1).max()))


def _things(sampler: Sampler, count: int) -> list[Body]:
    """Up to so many things at the origin, each of another name or colour; fewer where the shelves have no more.

    The first one can be grasped; SceneError when none can.
    """
    kinds = [kind for shelf in sampler.shelves for kind in shelf.kinds if kind.numbers(sampler.object_split)]
    if not kinds:
        raise SceneError(f"The shelves have nothing for --object-split {sampler.object_split}.")
    left = [(kind, color) for kind in kinds for color in kind.colors or _COLORS]
    things: dict[str, Body] = {}
    while left and len(things) < count:
        kind = sampler.choice(list({kind.noun: kind for kind, _ in left}.values()))
        color = sampler.choice([color for other, color in left if other.noun == kind.noun])
        left = [entry for entry in left if (entry[0].noun, entry[1]) != (kind.noun, color)]
        thing = make_object(sampler, kind, sampler.choice(kind.numbers(sampler.object_split)), color)
        if things or sampler.can_grasp(thing.shape):
            things[thing.name] = thing
    if not things:
        raise SceneError("The gripper finds no grasp of any thing on the shelves: give others with --objects.")
    return list(things.values())


_COLORS = tuple(name for name in COLORS if name != "green")


def make_object(sampler: Sampler, kind: Kind, number: int, color_name: str) -> Body:
    """A thing from a shelf as it rests at the world's origin, with drawn density and friction of its material."""
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
        rgba=COLORS[color_name],
        color_name=color_name,
        yaw_symmetry=kind.yaw_symmetry,
    )


def _standing(thing: Body, point: tuple[float, float], yaw: float, role: Role = "object") -> Body:
    """The thing where it shall stand; from half a millimetre above the table."""
    height = float(thing.world_from_body.position[2]) + 5e-4
    return replace(thing, role=role, world_from_body=Pose.from_yaw((*point, height), yaw))


def _resting(thing: Body, point: Sequence[float], floor: float = 0.0) -> Pose:
    """Where the origin of a standing thing is on a floor."""
    return Pose.from_yaw((point[0], point[1], floor + float(thing.world_from_body.position[2]) - 5e-4), 0.0)


def _mark_and_goal(sampler: Sampler, wanted: Body, start: tuple[float, float]) -> tuple[Body, Goal]:
    place = sampler.point(WORKSPACE, away_from=[start], min_distance=0.16, what="the target")
    target = mark("green_target", place, sampler.yaw(), side=0.10, color_name="green")
    return target, Goal(object=wanted.name, onto="", onto_from_goal=_resting(wanted, place), yaw_symmetry=0)


def _tray_and_goal(sampler: Sampler, wanted: Body) -> tuple[Body, Goal]:
    point, yaw = sampler.point(TRAYS, what="the tray"), sampler.uniform(-0.25, 0.25)
    target = tray("blue_tray", point, yaw, color_name="blue")
    offset = (sampler.uniform(-0.03, 0.03), sampler.uniform(-0.02, 0.02))
    pose = _resting(wanted, offset, TRAY_FLOOR)
    return target, Goal(object=wanted.name, onto=target.name, onto_from_goal=pose, yaw_symmetry=0)
