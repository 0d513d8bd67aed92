"""AUC of the scores of `demorec check` between sound and spoilt demonstrations, overall and by kind of fault.

    python benchmarks/curation.py --out curation                              all of it
    python benchmarks/curation.py --out curation --small                      to see that it runs: a minute
    python benchmarks/curation.py --out curation --episodes 40 --only stack/panda/7

Simulates episodes, of which 30 in 100 are spoilt, and writes their states and actions with LeRobot's own writer: with
demorec's names, and in a foreign format (degrees, gripper in per cent, half the rate, other names). Slips, detours and
hesitations happen in the simulation: the carried object is pulled out of the hand, the arm moves aside and comes back,
the arm stands still. The other faults are made of sound episodes: noise on the actions, actions some frames late, the
end cut off. Their sizes are drawn, from hardly noticeable on. Simulated episodes stay in OUT and are reused.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.errors import SceneError
from demorec.core.processes import in_turn
from demorec.episode.episode import Action
from demorec.loop import ScriptAgent, Session, SimulatorCache, Step, prepare
from demorec.sim.world import World

SIMULATED = ("slip", "detour", "hesitation")
KINDS = (*SIMULATED, "label noise", "late actions", "cut end")
MEASURED = ("stack/panda/7", "unstack/iiwa/8", "pick_from_clutter/panda/9")
FPS = 20
SPOILT, ATTEMPTS = 0.3, 40


@dataclass(kw_only=True)
class Demonstration:
    """(T, D) states and actions."""

    kind: str
    instruction: str
    state: NDArray[Any]
    action: NDArray[Any]


class Clumsy:
    """The expert with one fault, which happens at a random time of a phase."""

    num_retries, happened = 0, False

    def __init__(self, inner: ScriptAgent, kind: str, rng: np.random.Generator) -> None:
        self._inner, self._kind, self._rng = inner, kind, rng
        self._phase = "transport" if kind == "slip" else str(rng.choice(["approach", "transport"]))
        self._after = int(rng.integers(4, 12))

    def failure(self, failed: Sequence[str]) -> tuple[str, str]:
        return self._inner.failure(failed)

    def decide(self, world: World) -> Iterator[Step]:
        count, held, friction = 0, -1, 0.0
        for step in self._inner.decide(world):
            yield step
            count += step.phase == self._phase or count >= self._after
            if self._kind != "slip":
                if count == self._after:
                    self.happened = True
                    yield from self._fault(world, step)
            elif count == self._after:
                held = world._bodies[max((body.name for body in world.scene.movable), key=world.grip_force)]
                friction = world.client.getDynamicsInfo(held, -1)[1]
                world.client.changeDynamics(held, -1, lateralFriction=0.0)
            elif count == self._after + FPS:  # what lies there can be grasped again
                world.client.changeDynamics(held, -1, lateralFriction=friction)
            if self._kind == "slip" and self._after <= count < self._after + FPS and not self.happened:
                self.happened = not world.client.getContactPoints(world.arm.body, held)
                world.client.resetBaseVelocity(held, linearVelocity=[0.0, 0.0, -0.3])

    def _fault(self, world: World, step: Step) -> Iterator[Step]:
        rng, hold = self._rng, world.hold()
        seconds = float(rng.uniform(0.8, 2.0) if self._kind == "hesitation" else rng.uniform(1.2, 2.5))
        way = np.zeros(len(hold.joint_target))
        if self._kind == "detour":
            way[0], way[1] = rng.choice([-1, 1]) * rng.uniform(0.2, 0.5), -rng.uniform(0.0, 0.2)
        for t in range(1, round(seconds * FPS) + 1):
            target = hold.joint_target + way * np.sin(np.pi * t / round(seconds * FPS)) ** 2
            action = Action(
                joint_target=target,
                gripper_target=hold.gripper_target,
                base_from_tcp_target=world.arm.kinematics.forward(target),
            )
            yield replace(step, action=action, command=action, events=())


def simulate(job: tuple[str, int, str, str]) -> Path:
    """One episode of a cell "task/robot/seed", kept in a file."""
    cell, index, kind, folder = job
    path = Path(folder) / f"{index:04d}.npz"
    if path.exists():
        return path
    task, robot, seed = cell.split("/")
    rng = np.random.default_rng([int(seed), index])
    config = GenerateConfig(task=task, robot=robot, seed=int(seed), fps=FPS, cameras=())
    for attempt in range(ATTEMPTS):
        episode = prepare(EpisodePlan(config=config, episode_index=index, attempt=attempt))
        world, renderer = _cache().acquire(episode.info)
        session = Session.of_episode(world, episode, renderer)
        agent = ScriptAgent(episode) if kind not in SIMULATED else Clumsy(ScriptAgent(episode), kind, rng)
        try:
            frames = list(session.run(agent))
        except SceneError:
            continue
        if agent.happened if isinstance(agent, Clumsy) else session.outcome.success:
            break
    else:
        raise SystemExit(f"No attempt at episode {index} of {cell} became {kind or 'sound'}.")
    num_arm = len(world.robot.arm_joints)
    arrays: dict[str, Any] = {
        "state": [[*f.observation.joint_position[:num_arm], f.observation.gripper_width] for f in frames],
        "action": [[*f.action.joint_target, f.action.gripper_target] for f in frames],
        "instruction": episode.info.instruction,
    }
    np.savez(path, **arrays)
    return path


_caches: list[SimulatorCache] = []


def _cache() -> SimulatorCache:
    if not _caches:
        _caches.append(SimulatorCache())
    return _caches[0]


def kinds_of(cell: str, episodes: int) -> list[str]:
    """What is wrong with each episode, "" for nothing: as many of each kind, in random order."""
    count = round(SPOILT * episodes)
    kinds = [KINDS[number % len(KINDS)] for number in range(count)] + [""] * (episodes - count)
    return [str(kind) for kind in np.random.default_rng(int(cell.split("/")[2])).permutation(kinds)]


def demonstrations(folder: Path, cell: str, kinds: Sequence[str], *, stride: int) -> Iterator[Demonstration]:
    """Of a cell, spoilt; every `stride`-th frame, with the action that was reached last before the next."""
    loaded = [np.load(folder / f"{index:04d}.npz") for index in range(len(kinds))]
    spread = np.ptp(np.concatenate([each["action"] for each in loaded]), axis=0)
    for number, (each, kind) in enumerate(zip(loaded, kinds, strict=True)):
        rng = np.random.default_rng([int(cell.split("/")[2]), number, 1])
        action = each["action"][stride - 1 :: stride]
        count = len(action)
        state = each["state"][::stride][:count]
        fps = FPS // stride
        match kind:
            case "label noise":
                sigma = float(rng.uniform(0.005, 0.03)) * spread[:-1]
                action[:, :-1] += rng.normal(size=action[:, :-1].shape) * sigma
            case "late actions":
                late = max(1, round(float(rng.uniform(0.1, 0.3)) * fps))
                action = np.concatenate([np.repeat(action[:1], late, axis=0), action[:-late]])
            case "cut end":
                count = round(count * float(rng.uniform(0.55, 0.85)))
        yield Demonstration(kind=kind, instruction=str(each["instruction"]), state=state[:count], action=action[:count])


def write(root: Path, found: Sequence[Demonstration], *, fps: int, is_foreign: bool) -> None:
    """A dataset by LeRobot's writer; the foreign one in degrees and per cent, with names unknown to demorec."""
    from lerobot.datasets import LeRobotDataset

    count = found[0].state.shape[1]
    names = [*(f"panda_joint{number}" for number in range(1, count)), "gripper.width"]
    factor = np.ones(count)
    if is_foreign:
        names = [*(f"axis_{number}.pos" for number in range(1, count)), "gripper.pos"]
        factor = np.array([np.degrees(1.0)] * (count - 1) + [100 / 0.08])
    vector = {"dtype": "float32", "shape": (count,), "names": names}
    features = {"observation.state": vector, "action": vector}
    dataset = LeRobotDataset.create("local/x", fps=fps, features=features, root=root, use_videos=False)
    for each in found:
        for t in range(len(each.state)):
            frame: dict[str, Any] = {
                "observation.state": (each.state[t] * factor).astype(np.float32),
                "action": (each.action[t] * factor).astype(np.float32),
            }
            dataset.add_frame({**frame, "task": each.instruction})
        dataset.save_episode()
    dataset.finalize()


def auc(good: Sequence[float], bad: Sequence[float]) -> float:
    """Share of the pairs in which the good one has the higher score; equal ones count half (Mann-Whitney)."""
    differences = np.subtract.outer(np.array(good), np.array(bad))
    return float((differences > 0).mean() + 0.5 * (differences == 0).mean())


def measured(out: Path, cell: str, episodes: int, workers: int) -> Iterator[tuple[str, str, float]]:
    """(format, kind, score) of every episode of a cell; prints what each costs."""
    name, kinds = cell.replace("/", "_"), kinds_of(cell, episodes)
    folder = out / "simulated" / name
    folder.mkdir(parents=True, exist_ok=True)
    for _ in in_turn(simulate, [(cell, i, kind, str(folder)) for i, kind in enumerate(kinds)], workers):
        pass
    for form, stride in (("own", 1), ("foreign", 2)):
        found = list(demonstrations(folder, cell, kinds, stride=stride))
        root = out / f"{name}_{form}"
        if not root.exists():
            write(root, found, fps=FPS // stride, is_foreign=form == "foreign")
        command = [Path(sys.executable).parent / "demorec", "check", root, "--no-images", "--json"]
        begun = time.perf_counter()
        answer = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
        print(f"{root.name}: {time.perf_counter() - begun:.1f} s for {len(found)} episodes", file=sys.stderr)
        rows = sorted(json.loads(answer.stdout)["episodes"], key=lambda row: int(row["episode"]))
        (out / f"{name}_{form}.json").write_text(answer.stdout)
        yield from ((form, each.kind, row["score"]) for each, row in zip(found, rows, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for episodes and datasets")
    parser.add_argument("--episodes", type=int, default=80, help="of each cell")
    parser.add_argument("--only", nargs="*", default=MEASURED, help="cells task/robot/seed")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--small", action="store_true", help="16 episodes of one cell, 5 of them spoilt")
    args = parser.parse_args()
    if args.small:
        args.episodes, args.only = 16, MEASURED[:1]
    scores: dict[tuple[str, str], list[float]] = {}
    lines = []
    for cell in args.only:
        own: dict[tuple[str, str], list[float]] = {}
        for form, kind, score in measured(args.out, cell, args.episodes, args.workers):
            scores.setdefault((form, kind), []).append(score)
            own.setdefault((form, kind), []).append(score)
        lines += [table(f"{cell} {form}", own, form) for form in ("own", "foreign")]
    lines += [table(f"all {form}", scores, form) for form in ("own", "foreign")]
    print("\n".join(lines))


def table(title: str, scores: dict[tuple[str, str], list[float]], form: str) -> str:
    """A line: AUC over all, then of each kind with the number of its episodes."""
    good = scores[form, ""]
    bad = {kind: values for kind in KINDS if (values := scores.get((form, kind)))}
    everything = [value for values in bad.values() for value in values]
    cells = [f"{kind} {auc(good, values):.3f} ({len(values)})" for kind, values in bad.items()]
    kept = [sum(value > 0.8 for value in values) / len(values) for values in (good, everything)]
    return (
        f"{title}: AUC {auc(good, everything):.3f}; {', '.join(cells)}; "
        f"above 0.8: {kept[0]:.0%} of the sound, {kept[1]:.0%} of the spoilt"
    )


if __name__ == "__main__":
    main()
