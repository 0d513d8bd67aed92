"""How deep fingers sink into what they hold, whether it slips, how often tasks succeed, and what physics costs.

    python benchmarks/grasps.py --episodes 340 --workers 8 --out grasps.jsonl     # all tasks, both arms: 20,000 grasps
    python benchmarks/grasps.py --robots panda --against path/of/boxed_fingers.urdf --episodes 50

Whole episodes without images. The depth is that of a finger's collision shapes in the object's, from poses alone. A
grasp slips when the object moves by more than a millimetre in the hand while it is lifted and carried. `--against`
simulates every episode once more, right after, with another URDF of the same robot, to compare fingers.
The episodes that stand in `--out` already are not made again: the same command goes on after `--minutes` or Ctrl-C.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import multiprocessing
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from demorec.check.gripper import Convex, depth_in

from demorec.check.rows import LinkMatrices, inverse, matrices
from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.errors import SceneError
from demorec.core.geometry import Array
from demorec.core.tables import ROBOTS, TASKS
from demorec.episode.episode import Frame
from demorec.episode.mesh import decode_mesh
from demorec.episode.scene import Body
from demorec.loop import ScriptAgent, Session, make_world, prepare
from demorec.loop.prepare import Episode
from demorec.robots.assets import asset_path, mesh_path
from demorec.robots.urdf import Urdf, UrdfLink, read_links

LIMIT = 0.001
"""Of depth and slip, metres."""
MAX_FORCE = 100.0
"""N of both fingers together."""
Cell = tuple[str, str, str]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One episode; lengths in metres, times in seconds.

    Attributes:
        grasps: How often something was lifted.
        depth, deepest: Of the deepest finger, and where: phase and object.
        force: The largest of the fingers' forces at a frame, of both together, N.
        slip: The largest motion of a lifted object in the hand.
        cpu, simulated: CPU time of reset and control loop, and simulated time.
        other_depth, other_cpu, other_simulated: The same with the other URDF; 0 without `--against`.
    """

    task: str
    robot: str
    variation: str
    seed: int
    split: str
    index: int
    success: bool = False
    first_try: bool = False
    grasps: int = 0
    depth: float = 0.0
    deepest: str = ""
    force: float = 0.0
    slip: float = 0.0
    cpu: float = 0.0
    simulated: float = 0.0
    other_depth: float = 0.0
    other_cpu: float = 0.0
    other_simulated: float = 0.0

    @property
    def is_crushed(self) -> bool:
        """Whether no real hand could have done it."""
        return self.depth > LIMIT or self.force > MAX_FORCE


def run_episode(config: GenerateConfig, index: int, against: str = "") -> Row:
    """Simulate and measure one episode; one without a layout has no frames."""
    row = Row(
        task=config.task,
        robot=config.robot,
        variation=config.variation,
        seed=config.seed,
        split=config.split,
        index=index,
    )
    try:
        episode = prepare(EpisodePlan(config=config, episode_index=index))
    except SceneError:
        return row
    with make_world(episode.info) as world:
        session = Session.of_episode(world, episode)
        cpu, frames = _timed(session, episode)
    depth, deepest = deepest_finger(episode, frames)
    grasps, slip = lifted(episode, frames)
    row = replace(
        row,
        success=bool(session.outcome.success),
        first_try=bool(session.outcome.success) and session.outcome.num_retries == 0,
        grasps=grasps,
        depth=depth,
        deepest=deepest,
        force=max((frame.observation.contact_force for frame in frames), default=0.0),
        slip=slip,
        cpu=cpu,
        simulated=len(frames) / config.fps,
    )
    if not against:
        return row
    other = replace(episode, info=episode.info.with_simulation(robot=replace(episode.info.robot, urdf=against)))
    with make_world(other.info) as world:
        cpu, frames = _timed(Session.of_episode(world, other), other)
    return replace(
        row,
        other_depth=deepest_finger(other, frames)[0],
        other_cpu=cpu,
        other_simulated=len(frames) / config.fps,
    )


def _timed(session: Session, episode: Episode) -> tuple[float, list[Frame]]:
    started = time.process_time()
    frames = list(session.run(ScriptAgent(episode)))
    return time.process_time() - started, frames


def deepest_finger(episode: Episode, frames: Sequence[Frame]) -> tuple[float, str]:
    """Depth, metres, of the deepest finger in a movable body, with phase and body; 0 where none touches one."""
    robot, scene = episode.info.robot, episode.info.scene
    path, scale = asset_path(robot.urdf), scene.robot.scale
    links = {link.name: link for link in read_links(path.read_text(), scale=scale)}
    urdf = Urdf.load(path, scale=scale)
    joints = np.array([frame.observation.joint_position for frame in frames])
    base = scene.robot.world_from_base.matrix()
    deepest = (0.0, "")
    for name in robot.gripper.finger_links:
        by_name = dict(zip(robot.joint_names, joints.T, strict=True))
        finger = base @ LinkMatrices(urdf, by_name, len(frames))[name]
        parts = _parts(links[name], path.parent)
        for body in scene.movable:
            pose = _poses(frames, body)
            for part, piece in itertools.product(parts, _pieces(body)):
                gap = np.linalg.norm(_centres(piece, pose) - _centres(part, finger), axis=1)
                near = np.flatnonzero(gap < part.reach + piece.reach)
                if not len(near):
                    continue
                depth = depth_in(part, finger[near], piece, pose[near])
                frame = frames[int(near[int(np.argmax(depth))])]
                deepest = max(deepest, (float(depth.max()), f"{frame.phase} {body.name} frame {frame.frame_index}"))
    return deepest


def lifted(episode: Episode, frames: Sequence[Frame]) -> tuple[int, float]:
    """How often something was lifted, and how far, metres, it moved in the hand at most until it was lowered."""
    hand = episode.info.scene.robot.world_from_base.matrix() @ matrices(
        np.array([frame.observation.base_from_tcp.vector() for frame in frames])
    )
    count, slip = 0, 0.0
    for carried, group in itertools.groupby(frames, key=lambda frame: frame.phase in ("lift", "transport")):
        rows = [frame.frame_index for frame in group]
        if not carried:
            continue
        held = {body.name: inverse(hand[rows]) @ _poses(frames, body)[rows] for body in episode.info.scene.movable}
        nearest = min(held.values(), key=lambda pose: float(np.linalg.norm(pose[0, :3, 3])))
        if np.linalg.norm(nearest[0, :3, 3]) < 0.05 and frames[rows[0]].observation.contact_force > 0:
            count += 1
            slip = max(slip, float(np.linalg.norm(nearest[:, :3, 3] - nearest[0, :3, 3], axis=1).max()))
    return count, slip


def _centres(body: Convex, world_from_body: Array) -> Array:
    """(T, 3) in the world, metres, for poses (T, 4, 4)."""
    return np.asarray(world_from_body[:, :3, :3] @ body.centre + world_from_body[:, :3, 3])


def _poses(frames: Sequence[Frame], body: Body) -> Array:
    return matrices(np.array([frame.observation.object_poses[body.name].vector() for frame in frames]))


def _pieces(body: Body) -> list[Convex]:
    """What PyBullet makes of a body: a mesh from a file becomes its convex hull, one in the scene has its parts."""
    shape = body.shape
    if shape.kind == "urdf":
        path = asset_path(shape.file)
        return [p for link in read_links(path.read_text(), scale=shape.scale) for p in _parts(link, path.parent)]
    if shape.kind == "mesh":
        hulls = (
            _parts_of(shape.mesh, shape.scale) if shape.mesh else [_hull(asset_path(shape.file), (shape.scale,) * 3)]
        )
        return [hull.moved(shape.body_from_mesh.matrix()) for hull in hulls]
    return [Convex.of_shape(shape)]


def _parts(link: UrdfLink, folder: Path) -> list[Convex]:
    return [
        (_hull(mesh_path(folder, s.file), s.size) if s.kind == "mesh" else Convex.of_shape(s)).moved(
            s.link_from_shape.matrix()
        )
        for s in link.collisions
    ]


@functools.cache
def _hull(path: Path, scale: tuple[float, ...]) -> Convex:
    import trimesh

    mesh = trimesh.load(path, force="mesh", process=False)
    return _hull_of(np.asarray(mesh.vertices) * np.array(scale))


@functools.lru_cache(maxsize=64)
def _parts_of(text: str, scale: float) -> list[Convex]:
    mesh = decode_mesh(text)
    return [_hull_of(scale * mesh.points[rows]) for rows in mesh.parts]


def _hull_of(points: Array) -> Convex:
    import trimesh

    hull = trimesh.convex.convex_hull(points)
    return Convex(points=np.asarray(hull.vertices), axes=np.unique(hull.face_normals.round(6), axis=0).T)


def _warm_up() -> None:
    """Compile the kinematics and load what is loaded once, so that no episode's CPU time has it."""
    run_episode(GenerateConfig(cameras=()), 0)


def portion(jobs: Iterable[tuple[GenerateConfig, int]], args: argparse.Namespace) -> Iterator[Row]:
    """Rows as they are made, in worker processes, until all jobs or the time are over."""
    end = time.monotonic() + 60 * args.minutes
    waiting: set[Future[Row]] = set()
    jobs = iter(jobs)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(args.workers, mp_context=context, initializer=_warm_up) as pool:
        while True:
            room = 2 * args.workers - len(waiting) if time.monotonic() < end else 0
            for config, index in itertools.islice(jobs, room):
                waiting.add(pool.submit(run_episode, config, index, args.against))
            if not waiting:
                return
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)


def table(rows: Sequence[Row]) -> Iterator[str]:
    """Lines of a table with one line a cell, and a last one for all."""
    cells: dict[Cell, list[Row]] = defaultdict(list)
    for row in rows:
        cells[row.task, row.robot, row.variation].append(row)
    yield (
        "| task | robot | variation | success | first try | grasps | depth mm (median / max) | force N (max) "
        "| crushed: all / successes | slips |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for name, members in [*sorted(cells.items()), (("all", "", ""), list(rows))]:
        depths = 1e3 * np.array([row.depth for row in members])
        yield (
            f"| {' | '.join(name)} | {sum(r.success for r in members)}/{len(members)} "
            f"| {sum(r.first_try for r in members)} | {sum(r.grasps for r in members)} "
            f"| {np.median(depths):.2f} / {depths.max():.2f} | {max(r.force for r in members):.0f} "
            f"| {sum(r.is_crushed for r in members)} / {sum(r.is_crushed and r.success for r in members)} "
            f"| {sum(r.slip > LIMIT for r in members)} episodes |"
        )


def main() -> None:
    """Make what is missing and print all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["all"], help="names, or all")
    parser.add_argument("--robots", nargs="+", default=["all"], help="names, or all")
    parser.add_argument("--variations", nargs="+", default=["none", "mild", "full"])
    parser.add_argument("--episodes", type=int, default=10, help="of each cell (task, robot, variation)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--split", default="all", choices=["all", "train", "eval"])
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=1e6, help="start no episode after so long")
    parser.add_argument("--against", default="", metavar="URDF", help="simulate each episode with this URDF as well")
    parser.add_argument("--out", type=Path, help="a line of JSON for each episode; what stands there is not made again")
    args = parser.parse_args()
    tasks = TASKS.names() if args.tasks == ["all"] else args.tasks
    robots = ROBOTS.names() if args.robots == ["all"] else args.robots
    configs = [
        GenerateConfig(task=task, robot=robot, variation=variation, seed=args.seed, split=args.split, cameras=())
        for task, robot, variation in itertools.product(tasks, robots, args.variations)
        if not TASKS.load(task).refusal(ROBOTS.load(robot))
    ]
    rows = [Row(**json.loads(line)) for line in args.out.open()] if args.out and args.out.exists() else []
    known = {(row.task, row.robot, row.variation, row.seed, row.split, row.index) for row in rows}
    jobs = [
        (config, index)
        for index, config in itertools.product(range(args.episodes), configs)
        if (config.task, config.robot, config.variation, config.seed, config.split, index) not in known
    ]
    for row in portion(jobs, args):
        rows.append(row)
        if row.is_crushed or row.slip > LIMIT or not row.success:
            print(json.dumps(asdict(row)), flush=True)
        if args.out:
            with args.out.open("a") as file:
                file.write(json.dumps(asdict(row)) + "\n")
    print("\n".join(table(rows)))
    simulated = sum(row.simulated for row in rows)
    print(f"CPU ms per simulated second: {1e3 * sum(row.cpu for row in rows) / max(simulated, 1e-9):.1f}")
    compared = [row for row in rows if row.other_simulated]
    if compared:
        now = sum(row.cpu for row in compared) / sum(row.simulated for row in compared)
        other = sum(row.other_cpu for row in compared) / sum(row.other_simulated for row in compared)
        deeper = sum(row.other_depth > LIMIT for row in compared)
        print(
            f"against {args.against}, {len(compared)} episodes: CPU time {now / other:.3f} times, deeper than 1 mm "
            f"in {sum(row.depth > LIMIT for row in compared)}, in {deeper} with the other"
        )


if __name__ == "__main__":
    main()
