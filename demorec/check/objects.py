"""Do objects behave like things: still unless touched, never through each other, carried only by a closed hand."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Found, Measurement, physics_check, worst_entry, worst_frame
from demorec.check.episode import CheckedEpisode
from demorec.check.gripper import NEAR, SOLID, depth_of_link, top_of
from demorec.check.rows import angle_between, displacement, held_for, inverse, longest_run, matrices
from demorec.core.geometry import Array
from demorec.episode.scene import Body, Shape

COAST_SECONDS = 0.7
"""How long a thing may go on moving by itself after it was last touched."""
_TUMBLES = 1.5
"""Times as fast as two frames before or after a thing may turn that tumbles."""
_RESTS = 0.02
"""m/s, 0.1 of them for each rad/s, below which a thing is at rest."""
_LIES, _LAIN_SECONDS = 0.005, 0.15
"""m/s below which a thing lies still, and for how long before it counts as lying there."""
_GAP = 0.005
"""Metres above a support from which on it bears nothing."""
_CARRIED = 0.01
"""Metres above its start from which on a hand may carry something."""
_PRESSED, _PRESSED_BLINDLY, _IN_HAND = 0.002, 0.004, 0.05
"""Metres by which a hand presses what it lowers into a support at most, the same in an attempt that failed (2.6 mm were
seen), and of what it holds from its TCP."""
_STILL, _AT_REST = 2e-5, 10.0
"""Metres in a frame that are no motion, and what a depth counts where nothing moves and fingers touch nothing: of 355
episodes of all tasks 0.15 mm at most."""


def _speeds(episode: CheckedEpisode, name: str) -> Array:
    """(T - 1, 3) m/s between frames."""
    return np.asarray(np.diff(episode.columns.object_poses[name][:, :3], axis=0) * episode.info.fps)


def _radius(body: Body) -> float:
    """Of its bounding sphere, metres."""
    return math.hypot(*body.shape.extents) / 2


def _near_hand(episode: CheckedEpisode, body: Body) -> NDArray[np.bool_]:
    """(T,) whether hand or fingers may touch a body: its bounding sphere and a hand's breadth overlap."""
    radius, hand = _radius(body), episode.world_from_link(episode.info.robot.hand_link)
    centre = episode.columns.object_poses[body.name][:, :3]
    near_tcp = np.linalg.norm(episode.world_from_tcp[:, :3, 3] - centre, axis=1) < radius + 0.06
    near_hand = np.linalg.norm(hand[:, :3, 3] - centre, axis=1) < radius + 0.12
    return np.asarray(near_tcp | near_hand)


def _touched(episode: CheckedEpisode) -> dict[str, NDArray[np.bool_]]:
    """name -> (T - 1,) whether a movable body may have been pushed between frames t and t + 1.

    By the hand, or by another movable body that is near it and was itself pushed less than a moment ago.
    """
    bodies = [body for body in episode.info.scene.movable if body.name in episode.columns.object_poses]
    coast = round(COAST_SECONDS * episode.info.fps)
    active = {}
    for body in bodies:
        near = _near_hand(episode, body)
        velocity = _speeds(episode, body.name)
        # What starts in the air falls straight down, and comes to rest after that.
        falling = velocity[:, 2] < -0.05 - 3.0 * np.linalg.norm(velocity[:, :2], axis=1)
        active[body.name] = held_for(near[:-1] | near[1:] | falling, coast)
        if body.shape.kind != "box":  # what is round or odd rocks on until it rests
            pose = episode.world_from_object(body.name)
            moves = displacement(pose[1:], pose[:-1]) * episode.info.fps > _RESTS
            for frame in np.flatnonzero(moves).tolist():
                if active[body.name][frame]:
                    active[body.name][frame : frame + coast + 1] = True
    for _ in range(len(bodies) - 1):  # a push travels from body to body
        for body in bodies:
            for other in bodies:
                if other.name == body.name:
                    continue
                poses = episode.columns.object_poses
                gap = np.linalg.norm(poses[body.name][:, :3] - poses[other.name][:, :3], axis=1)
                close = (gap < _radius(body) + _radius(other) + 0.01)[:-1] & active[other.name]
                active[body.name] = active[body.name] | held_for(close, coast)
    return active


@physics_check(
    measures="fastest motion of an object that nothing touches",
    unit="m/s",
)
def object_motion(episode: CheckedEpisode) -> Iterator[Found]:
    """An object moves or turns only when touched, or for a moment after it (falling, rolling, tipping). What lies still
    is woken by a force on the fingers, also in the hand's reach, by another object, by a hand that comes within 2 mm of
    it (boxes, spheres, cylinders, capsules), or by fingers that open or shut (meshes, of which they may have pushed one
    aside between two frames).

    0.1 m/s are counted for each rad/s. Of meshes over a thirtieth of a second at least: at rest they twitch.
    """
    fps, force = episode.info.fps, episode.columns.contact_force
    fingers_move = np.abs(np.diff(episode.columns.gripper_width)) > NEAR
    speeds = {
        name: displacement(pose[1:], pose[:-1]) * fps
        for name, pose in ((name, episode.world_from_object(name)) for name in episode.columns.object_poses)
    }
    quiet = np.zeros(max(len(force) - 1, 0), dtype=np.bool_)  # in the frames before and after a step and around these
    quiet[1:-1] = np.max([force[:-3], force[1:-2], force[2:-1], force[3:]], axis=0) == 0 if len(force) > 3 else False
    moving = {name: speed > _LIES for name, speed in speeds.items()}
    lain, bodies = max(3, round(_LAIN_SECONDS * fps)), {body.name: body for body in episode.info.scene.movable}
    for name, touched in _touched(episode).items():
        lies = np.zeros_like(quiet)
        lies[lain:] = ~held_for(moving[name], lain - 1)[lain - 1 : -1]
        asleep = lies & quiet & ~np.any([rows for other, rows in moving.items() if other != name] or [~quiet], axis=0)
        is_solid = bodies[name].shape.kind in SOLID
        if (asleep & moving[name]).any():
            asleep &= ~(_at_hand(episode, bodies[name]) if is_solid else fingers_move)
        span = 1 if is_solid else max(1, round(fps / 30))
        free, count = ~touched | asleep, max(len(touched) - span + 1, 0)
        pose = episode.world_from_object(name)
        speed = displacement(pose[span:], pose[:-span]) * fps / span
        yield worst_frame(speed * np.all([free[k : k + count] for k in range(span)], axis=0), name, first=1)


def _at_hand(episode: CheckedEpisode, body: Body) -> NDArray[np.bool_]:
    """(T - 1,) whether hand or fingers are at a body in the frames before a step and after it."""
    robot = episode.info.robot
    links = (robot.hand_link, *robot.gripper.finger_links)
    near = np.max([depth_of_link(episode, link, body) for link in links], axis=0) > -NEAR
    return np.asarray(near[:-1] & near[1:])


@physics_check(
    measures="object speed beyond that of the hand and of falling",
    unit="m/s",
)
def teleports(episode: CheckedEpisode) -> Iterator[Found]:
    """No object jumps."""
    hand = displacement(episode.world_from_tcp[1:], episode.world_from_tcp[:-1]) * episode.info.fps
    for name in episode.columns.object_poses:
        velocity = _speeds(episode, name)
        falling = np.minimum(np.maximum(-velocity[:, 2], 0.0), 3.5)
        beyond = np.linalg.norm(velocity, axis=1) - hand - falling
        if (fastest := worst_frame(beyond, name, first=1)) is not None:
            yield replace(fastest, value=max(fastest.value, 0.0))


@physics_check(
    measures="object rotation beyond that of the hand and of rolling",
    unit="rad/s",
)
def spins(episode: CheckedEpisode) -> Iterator[Found]:
    """No object's rotation jumps: it turns with the hand that has it, rolls as fast as it moves past the hand, or turns
    as fast two frames before or after, as what tumbles does."""
    fps, hand = episode.info.fps, episode.world_from_tcp
    with_hand = angle_between(hand[1:], hand[:-1]) * fps
    of_hand = np.diff(hand[:, :3, 3], axis=0) * fps
    for name in episode.columns.object_poses:
        pose, velocity = episode.world_from_object(name), _speeds(episode, name)
        passing = np.minimum(np.linalg.norm(velocity, axis=1), np.linalg.norm(velocity - of_hand, axis=1))
        rolling = passing / (min(episode.info.scene.body(name).shape.extents) / 2)
        turning = angle_between(pose[1:], pose[:-1]) * fps
        beside = np.pad(turning, 2)
        beyond = turning - np.maximum(with_hand + rolling, _TUMBLES * np.maximum(beside[:-4], beside[4:]))
        yield worst_frame(np.maximum(beyond, 0.0), name, first=1)


@physics_check(
    measures="distance of the first frame from the scene's start",
    unit="m",
)
def starts_as_scene_says(episode: CheckedEpisode) -> Iterator[Found]:
    """Objects and joints begin where the scene put them (0.1 m per rad of rotation; 0.1 m per rad of a joint).

    Physics settles for 0.1 s before the first frame, in which an object may fall, by 5.5 cm at most.
    """
    c, scene = episode.columns, episode.info.scene
    if not c.num_frames:
        return
    joints = 0.1 * np.abs(c.joint_position[:1, : episode.num_arm] - np.array(scene.robot.joint_position))
    yield worst_entry(joints, episode.info.robot.arm_joints)
    yield worst_frame(np.abs(c.gripper_width[:1] - scene.robot.gripper_width), "gripper")
    for body in scene.movable:
        placed = matrices(body.world_from_body.vector()[None])
        placed[0, 2, 3] -= min(max(float(placed[0, 2, 3] - c.object_poses[body.name][0, 2]), 0.0), 0.055)
        yield worst_frame(displacement(matrices(c.object_poses[body.name][:1]), placed), body.name)


@physics_check(
    measures="depth to which a body is inside another",
    unit="m",
)
def penetration(episode: CheckedEpisode) -> Iterator[Found]:
    """Nothing solid is inside anything solid (boxes, spheres, cylinders, capsules).

    A hand that lowers something feels the support a frame late, and presses it, and what is below, by what it went down
    since, or less. One that failed may have pressed on without noticing, and says that it failed. What rests is hardly
    inside what bears it, and counts ten times.
    """
    scene, c = episode.info.scene, episode.columns
    tcp = episode.world_from_tcp[:, :3, 3]
    pressed = np.clip(-np.diff(tcp[:, 2], prepend=tcp[:1, 2]), 0.0, _PRESSED)
    if episode.outcome is not None and not episode.outcome.success:
        pressed = np.full_like(pressed, _PRESSED_BLINDLY)
    pressed *= c.contact_force > 0
    movable = [body for body in scene.movable if body.shape.kind in SOLID]
    still = [b for b in scene.bodies if b.collides and not b.movable and b.shape.kind in SOLID]
    for number, body in enumerate(movable):
        pose = episode.world_from_object(body.name)
        for other in (*still, *movable[number + 1 :]):
            other_pose = episode.world_from_object(other.name)
            reach = _radius(body) + _radius(other)
            near = np.flatnonzero(np.linalg.norm(pose[:, :3, 3] - other_pose[:, :3, 3], axis=1) < reach)
            if not len(near):
                continue
            depth = _depth_inside(body.shape, pose[near], other.shape, other_pose[near])
            if other.movable or _is_at_surface(pose[near, :3, 3], body, other):
                theirs = _depth_inside(other.shape, other_pose[near], body.shape, pose[near])
                depth = np.maximum(depth, theirs)
            across, above = pose[near, :2, 3] - tcp[near, :2], pose[near, 2, 3] - tcp[near, 2]
            held = (np.linalg.norm(across, axis=1) < _IN_HAND) & (above < _IN_HAND)
            rests = (_rests(pose) & _rests(other_pose) & (c.contact_force == 0))[near]
            depth = np.where(rests, _AT_REST * depth, depth - held * pressed[near])
            yield worst_frame(depth, f"{body.name} in {other.name}", frames=near)
    if movable:
        yield Measurement(value=0.0, detail="nothing comes near anything")


def _rests(pose: Array) -> NDArray[np.bool_]:
    """(T,) whether a body (T, 4, 4) is where it was a frame before and is a frame later."""
    still = np.linalg.norm(np.diff(pose[:, :3, 3], axis=0), axis=1) < _STILL
    return np.asarray(np.append(still, True) & np.append(True, still))


def _is_at_surface(centres: Array, body: Body, other: Body) -> bool:
    """Whether any surface point of a fixed body comes as near to a body as the body's own corners are."""
    pose = other.world_from_body.matrix()
    points = _surface_points(other.shape) @ pose[:3, :3].T + pose[:3, 3]
    least = np.linalg.norm(np.clip(points, centres.min(axis=0), centres.max(axis=0)) - points, axis=1).min()
    return bool(least <= _radius(body))


def _depth_inside(shape: Shape, pose: Array, other: Shape, other_pose: Array) -> Array:
    """(T,) how deep the deepest surface point of one shape lies inside another, metres, 0 outside."""
    points = _surface_points(shape)
    relative = inverse(other_pose) @ pose
    local = np.einsum("tij,pj->tpi", relative[:, :3, :3], points) + relative[:, None, :3, 3]
    half = np.array(other.extents) / 2
    if other.kind == "box":
        depth = (half - np.abs(local)).min(axis=2)
    elif other.kind == "sphere":
        depth = half[0] - np.linalg.norm(local, axis=2)
    elif other.kind == "cylinder":
        depth = np.minimum(half[0] - np.hypot(local[..., 0], local[..., 1]), half[2] - np.abs(local[..., 2]))
    else:
        axis_end = np.clip(local[..., 2], -other.size[1] / 2, other.size[1] / 2)
        depth = half[0] - np.sqrt(local[..., 0] ** 2 + local[..., 1] ** 2 + (local[..., 2] - axis_end) ** 2)
    return np.asarray(np.maximum(depth.max(axis=1), 0.0))


def _surface_points(shape: Shape) -> Array:
    """(P, 3) points of a solid's surface: corners and face centres of a box, rings of a round body."""
    half = np.array(shape.extents) / 2
    if shape.kind == "box":
        grid = np.array(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1])).reshape(3, -1).T
        return np.asarray(grid[np.abs(grid).max(axis=1) == 1] * half)
    angles = np.arange(16) * (2 * math.pi / 16)
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(16)], axis=1)
    poles = np.array([[0, 0, -half[2]], [0, 0, half[2]]])
    if shape.kind == "cylinder":
        ends = [ring * half[0] + [0, 0, z] for z in (-half[2], 0.0, half[2])]
        return np.concatenate([*ends, poles])
    middle = 0.0 if shape.kind == "sphere" else shape.size[1] / 2
    rows = [
        ring * [half[0] * math.cos(a), half[0] * math.cos(a), 0]
        + [0, 0, math.copysign(middle, a) + half[0] * math.sin(a)]
        for a in np.linspace(-1.2, 1.2, 7)
    ]
    return np.concatenate([*rows, poles])


@physics_check(
    measures="frames in which an object moves through the air unheld",
)
def carried_by_gripper(episode: CheckedEpisode) -> Iterator[Found]:
    """While an object travels above where it rests, fingers press on it and stand as far apart as it is wide."""
    c, fps = episode.columns, episode.info.fps
    if c.num_frames < 3 or not episode.info.scene.movable:
        return
    # A contact that a frame happens to miss is none that was lost: the strongest of three neighbours counts.
    force = np.max([c.contact_force[:-2], c.contact_force[1:-1], c.contact_force[2:]], axis=0)
    width = c.gripper_width[1:-1]
    for body in episode.info.scene.movable:
        pose = c.object_poses[body.name]
        velocity = (pose[2:, :3] - pose[:-2, :3]) * (fps / 2)
        fall = (pose[2:, 2] - 2 * pose[1:-1, 2] + pose[:-2, 2]) * fps**2 < -4.0
        # A fall, and what follows it for a moment, needs no hand.
        falling = held_for(fall | (velocity[:, 2] < -0.5), round(COAST_SECONDS * fps))
        travelling = (np.linalg.norm(velocity, axis=1) > 0.08) & (pose[1:-1, 2] > pose[0, 2] + 0.03) & ~falling
        distance = np.linalg.norm(pose[1:-1, :3] - episode.world_from_tcp[1:-1, :3, 3], axis=1)
        thinnest = min(body.shape.extents) - 0.004 if body.shape.kind in SOLID else 0.002
        held = (force > 0.3) & (distance < _radius(body) + 0.03) & (width > thinnest)
        wrong = travelling & ~held
        if wrong.any():
            frame = int(np.argmax(wrong))
            detail = (
                f"{body.name}: {force[frame]:.2f} N, {distance[frame] * 1e3:.0f} mm from the TCP, "
                f"opening {width[frame] * 1e3:.0f} mm"
            )
            yield Measurement(value=int(wrong.sum()), frame=frame + 1, detail=detail)
        else:
            yield Measurement(value=0, detail=f"{body.name} travels {int(travelling.sum())} frames")


@physics_check(
    measures="how far an object moves in the hand while nothing else bears it",
    unit="m",
)
def slips(episode: CheckedEpisode) -> Iterator[Found]:
    """What fingers press on in the air stays where it is in the hand, from one frame of it to any other (boxes,
    spheres, cylinders, capsules: a duck finds its place between the fingers)."""
    c, hand = episode.columns, inverse(episode.world_from_tcp)
    for body in (body for body in episode.info.scene.movable if body.shape.kind in SOLID):
        pose = episode.world_from_object(body.name)
        held = episode.is_carried(body.name, _CARRIED) & (c.contact_force > 0) & ~_is_borne(episode, body, pose)
        length, start = longest_run(held)
        place = (hand @ pose)[start : start + length, :3, 3]
        off = np.linalg.norm(place - np.median(place, axis=0), axis=1) if length else np.zeros(0)
        yield worst_frame(off, body.name, first=start)


@physics_check(
    measures="longest time in which an object hangs in the air, or sinks, with nothing that bears it",
    unit="s",
)
def falls_unheld(episode: CheckedEpisode) -> Iterator[Found]:
    """What no finger presses on and nothing is below falls freely: catches objects that are glued to the hand or stay
    in the air (boxes, spheres, cylinders, capsules)."""
    c, scene, fps = episode.columns, episode.info.scene, episode.info.fps
    if c.num_frames < 4:
        return
    free = (c.contact_force[:-2] == 0) & (c.contact_force[1:-1] == 0) & (c.contact_force[2:] == 0)
    gravity = scene.physics.gravity[2]
    for body in (body for body in scene.movable if body.shape.kind in SOLID):
        pose = episode.world_from_object(body.name)
        fall = np.diff(pose[:, 2, 3], 2) * fps**2
        wrong = free & (fall > 0.5 * gravity) & ~_is_borne(episode, body, pose)[1:-1]
        length, start = longest_run(wrong)
        yield Measurement(value=length / fps, frame=start + 1 if length else None, detail=body.name)


def _is_borne(episode: CheckedEpisode, body: Body, pose: Array) -> NDArray[np.bool_]:
    """(T,) whether anything is within reach below a body that may bear it, or beside it."""
    bottom = pose[:, 2, 3] - np.abs(pose[:, 2, :3]) @ (np.array(body.shape.extents) / 2)
    borne = np.zeros(len(pose), dtype=np.bool_)
    for other in episode.info.scene.bodies:
        if other.name == body.name or not other.collides:
            continue
        theirs = episode.world_from_object(other.name)[:, :3, 3]
        reach = _radius(body) + _radius(other) + _GAP
        if other.movable:
            borne |= np.linalg.norm(theirs - pose[:, :3, 3], axis=1) < reach
            continue
        across = np.linalg.norm(theirs[:, :2] - pose[:, :2, 3], axis=1)
        is_large = other.shape.kind not in SOLID or not other.shape.size  # a plane has no end
        borne |= ((across < reach) | is_large) & (bottom < top_of(other) + _GAP)
    return borne
