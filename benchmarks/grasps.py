"""Finger forces, slip of held objects, success of tasks, and the cost of physics.

    python benchmarks/grasps.py --episodes 340 --workers 8 --out grasps.jsonl     # all tasks, both arms: 20,000 grasps

Episodes are complete, without images. A grasp slips when the object moves by more than a millimetre in the hand while
it is lifted and carried. Episodes in `--out` are not repeated: the same command continues after `--minutes` or Ctrl-C.
"""

from __future__ import annotations

import argparse
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

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.errors import SceneError
from demorec.core.geometry import Array
from demorec.core.tables import ROBOTS, TASKS
from demorec.episode.episode import Frame
from demorec.episode.scene import Body
from demorec.extensions.doctor.checks.kinematics import matrices
from demorec.loop import ScriptAgent, Session, make_world, prepare
from demorec.loop.prepare import PreparedEpisode

LIMIT = 0.001
"""Limit of slip, metres."""
MAX_FORCE = 100.0
"""N of both fingers together."""
Cell = tuple[str, str, str]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One episode; lengths in metres, times in seconds.

    Attributes:
        grasps: Number of lifts.
        force: Maximum force of both fingers together at a frame, N.
        slip: Maximum motion of a lifted object in the hand.
        cpu, simulated: CPU time of reset and control loop, and simulated time.
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
    force: float = 0.0
    slip: float = 0.0
    cpu: float = 0.0
    simulated: float = 0.0

    @property
    def is_crushed(self) -> bool:
        """Whether the force exceeds that of any real hand."""
        return self.force > MAX_FORCE


def run_episode(config: GenerateConfig, index: int) -> Row:
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
    grasps, slip = lifted(episode, frames)
    return replace(
        row,
        success=bool(session.outcome.success),
        first_try=bool(session.outcome.success) and session.outcome.num_retries == 0,
        grasps=grasps,
        force=max((frame.observation.contact_force for frame in frames), default=0.0),
        slip=slip,
        cpu=cpu,
        simulated=len(frames) / config.fps,
    )


def _timed(session: Session, episode: PreparedEpisode) -> tuple[float, list[Frame]]:
    started = time.process_time()
    frames = list(session.run(ScriptAgent(episode)))
    return time.process_time() - started, frames


def lifted(episode: PreparedEpisode, frames: Sequence[Frame]) -> tuple[int, float]:
    """Number of lifts, and maximum motion of an object in the hand, metres, until it was lowered."""
    hand = episode.info.simulated.scene.robot.world_from_base.matrix() @ matrices(
        np.array([frame.observation.base_from_tcp.vector() for frame in frames])
    )
    count, slip = 0, 0.0
    for carried, group in itertools.groupby(frames, key=lambda frame: frame.phase in ("lift", "transport")):
        rows = [frame.frame_index for frame in group]
        if not carried:
            continue
        held = {
            body.name: np.linalg.inv(hand[rows]) @ _poses(frames, body)[rows]
            for body in episode.info.simulated.scene.movable
        }
        nearest = min(held.values(), key=lambda pose: float(np.linalg.norm(pose[0, :3, 3])))
        if np.linalg.norm(nearest[0, :3, 3]) < 0.05 and frames[rows[0]].observation.contact_force > 0:
            count += 1
            slip = max(slip, float(np.linalg.norm(nearest[:, :3, 3] - nearest[0, :3, 3], axis=1).max()))
    return count, slip


def _poses(frames: Sequence[Frame], body: Body) -> Array:
    return matrices(np.array([frame.observation.object_poses[body.name].vector() for frame in frames]))


def _warm_up() -> None:
    """Compile the kinematics and load libraries, so that no episode's CPU time includes them."""
    run_episode(GenerateConfig(cameras=()), 0)


def portion(jobs: Iterable[tuple[GenerateConfig, int]], args: argparse.Namespace) -> Iterator[Row]:
    """Rows as they are made, in worker processes, until all jobs are done or the time is up."""
    end = time.monotonic() + 60 * args.minutes
    waiting: set[Future[Row]] = set()
    jobs = iter(jobs)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(args.workers, mp_context=context, initializer=_warm_up) as pool:
        while True:
            room = 2 * args.workers - len(waiting) if time.monotonic() < end else 0
            for config, index in itertools.islice(jobs, room):
                waiting.add(pool.submit(run_episode, config, index))
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
        "| task | robot | variation | success | first try | grasps | force N (max) | crushed: all / successes | slips |"
    )
    yield "|---|---|---|---|---|---|---|---|---|"
    for name, members in [*sorted(cells.items()), (("all", "", ""), list(rows))]:
        yield (
            f"| {' | '.join(name)} | {sum(r.success for r in members)}/{len(members)} "
            f"| {sum(r.first_try for r in members)} | {sum(r.grasps for r in members)} "
            f"| {max(r.force for r in members):.0f} "
            f"| {sum(r.is_crushed for r in members)} / {sum(r.is_crushed and r.success for r in members)} "
            f"| {sum(r.slip > LIMIT for r in members)} episodes |"
        )


def main() -> None:
    """Make the missing episodes and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["all"], help="names, or all")
    parser.add_argument("--robots", nargs="+", default=["all"], help="names, or all")
    parser.add_argument("--variations", nargs="+", default=["none", "mild", "full"])
    parser.add_argument("--episodes", type=int, default=10, help="of each cell (task, robot, variation)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--split", default="all", choices=["all", "train", "eval"])
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=1e6, help="minutes after which no episode is started")
    parser.add_argument("--out", type=Path, help="a line of JSON for each episode; episodes in it are not repeated")
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


if __name__ == "__main__":
    main()
