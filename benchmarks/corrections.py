"""Benefit of corrections for a policy, compared with the same number of new plain demonstrations.

    python benchmarks/corrections.py --out outputs/corrections
    python benchmarks/corrections.py --seeds 1 --scenes 50 --rounds 1     # a first look

A policy is trained on --episodes plain demonstrations. Then, in --rounds, it acts in scenes of the training region of
the table, the expert takes over when it deviates, and the policy is trained again on all data, until --corrected
episodes have been corrected; only the expert's frames are used. For comparison, another policy is trained on the same
total number of plain demonstrations. Every training seed has separate policies and corrections. Trainings are those of
benchmarks/learning.py: LeRobot's ACT from numbers in memory, one thread; --steps updates for --episodes episodes,
proportionally more for larger datasets. Scenes are held out. Existing runs, corrections, datasets, policies and
evaluations in --out are reused, so the same command continues.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from learning import ACTION, ENVIRONMENT, STATE, SWITCHED_OFF, Data, Variant, command, statistics, train

from demorec.core.config import GenerateConfig
from demorec.episode.episode import interventions
from demorec.extensions.policies.evaluation import Evaluation, load_evaluation
from demorec.extensions.policies.rollouts import evaluate, settings_for
from demorec.extensions.policies.statistics import Rate
from demorec.extensions.policies.takeover import TakeOver
from demorec.mcap import Recording

INTERVENTION = "intervention"
CORRECTION_SEED = 1
"""Root seed of the corrected scenes; demonstrations use 0."""
_ABSOLUTE = re.compile(r"tcp\.[xy]|\w+(\.goal)?\.[xy]|.*\.pose\..*|\w+\.pos")
"""Components that describe absolute positions on the table, or the arm's pose.

A hundred demonstrations are too few to learn that these do not matter, so they are hidden from the policy.
"""
_VELOCITIES = re.compile(r"\w+\.vel")


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One policy of one training seed, with its evaluation.

    Attributes:
        arm: "plain", "corrected" or, before both, "start".
        corrected: Episodes that the expert has corrected so far.
        demonstrations: Number of plain demonstrations.
        frames: Number of training frames.
        updates: Number of updates in the training.
        evaluation: Result on the held-out scenes.
        cpu_seconds: CPU time of the training.
    """

    arm: str
    corrected: int
    demonstrations: int
    frames: int
    updates: int
    evaluation: Evaluation
    cpu_seconds: float

    @property
    def row(self) -> tuple[str, int, int]:
        """Row of the table that it belongs to."""
        return self.arm, self.demonstrations, self.corrected


def demonstrations(args: argparse.Namespace, count: int) -> Path:
    """Dataset of the first `count` plain demonstrations."""
    run = args.out / "run"
    command(
        *("generate-dataset", "--out", run, "--task", args.task, "--num-episodes", str(count), "--split", "train"),
        *("--workers", str(args.workers), "--no-export", "--cameras", "none"),
    )
    dataset = Path(args.out / "datasets" / f"plain_{count}_{args.action}")
    if not dataset.exists():
        export(run, dataset, args, f"0:{count}")
    return dataset


def export(run: Path, dataset: Path, args: argparse.Namespace, episodes: str) -> None:
    """Export to LeRobot, numbers only."""
    dataset.parent.mkdir(parents=True, exist_ok=True)
    command(
        *("demorec", "export", "lerobot", run, "--out", dataset, "--action", args.action, "--episodes", episodes),
        *("--privileged", "--intervention", "--features", ENVIRONMENT, INTERVENTION),
    )


def correct(policy: Path, wanted: int, first_scene_seed: int, args: argparse.Namespace, out: Path) -> Path:
    """Dataset of `wanted` corrected episodes: new scenes until the expert has taken over in that many."""
    dataset = out.with_name(f"{out.name}_{args.action}")
    if dataset.exists():
        return dataset
    config = GenerateConfig(task=args.task, split="train", seed=first_scene_seed, cameras=())
    rules = TakeOver(stray_metres=args.stray_metres, noise=args.noise)
    settings = replace(settings_for(policy, config, action=args.action), takeover=rules)
    out.parent.mkdir(parents=True, exist_ok=True)
    tried, corrected = 0, list[int]()
    while len(corrected) < wanted:
        tried += max(5, wanted - len(corrected))
        evaluate(settings, out, num_episodes=tried, workers=args.workers)
        corrected = corrected_episodes(out)
    export(out, dataset, args, ",".join(map(str, corrected[:wanted])))
    return dataset


def corrected_episodes(corrections: Path) -> list[int]:
    """Episodes in which the expert took over, did more than stop the arm, and succeeded."""
    corrected = []
    for rollout in load_evaluation(corrections).rollouts:
        if rollout.success:
            with Recording(corrections / rollout.file) as recording:
                if interventions(recording.phases).any():
                    corrected.append(rollout.episode_index)
    return corrected


def load(datasets: list[Path], *, hidden: tuple[re.Pattern[str], ...]) -> Data:
    """Load all frames in which the expert acts; a segment ends when the expert hands back."""
    parts: dict[str, list[np.ndarray[Any, Any]]] = defaultdict(list)
    for number, dataset in enumerate(datasets):
        tables = [pq.read_table(path) for path in sorted((dataset / "data").rglob("*.parquet"))]
        episode = np.concatenate([t["episode_index"].to_numpy() for t in tables])
        acts = np.concatenate([t[INTERVENTION].to_numpy(zero_copy_only=False) for t in tables]).astype(bool)
        acts |= ~np.isin(episode, episode[acts])  # in a plain demonstration all frames are the expert's
        begins = np.diff(episode, prepend=-1) != 0
        begins[1:] |= acts[1:] != acts[:-1]
        parts["stretch"].append((np.cumsum(begins) + 1_000_000 * number)[acts])
        for name in (STATE, ACTION, ENVIRONMENT):
            values = np.concatenate([np.stack(t[name].to_numpy()) for t in tables]).astype(np.float32)
            parts[name].append(values[acts])
    stretch = np.concatenate(parts.pop("stretch"))
    columns = {name: torch.from_numpy(np.concatenate(values)) for name, values in parts.items()}
    stats = {name: statistics(values) for name, values in columns.items()}
    features = json.loads((datasets[0] / "meta" / "info.json").read_text())["features"]
    for name in (STATE, ENVIRONMENT):
        for i, component in enumerate(features[name]["names"]):
            if any(pattern.fullmatch(component) for pattern in hidden):
                stats[name]["std"][i] = SWITCHED_OFF
    return Data(columns=columns, end=torch.from_numpy(np.searchsorted(stretch, stretch, side="right")), stats=stats)


def stage(arm: str, datasets: list[Path], corrected: int, seed: int, args: argparse.Namespace) -> tuple[Stage, Path]:
    """Train on datasets and evaluate the policy; returns its folder, too."""
    count = args.episodes + (args.corrected if arm == "plain" else 0)
    updates = round(args.steps * (count + corrected) / args.episodes)
    label = f"{args.label}_{args.rules}" if arm == "corrected" else args.label
    out = args.out / "policies" / f"{arm}_{count}_{corrected}_{label}_{seed}"
    data = load(datasets, hidden=args.hidden)
    if not (out / "training.json").exists():
        print(f"training {out.name} on {len(data.end)} frames", flush=True)
        train(data, args.variant, argparse.Namespace(**vars(args) | {"steps": updates}), seed=seed, out=out)
    training = json.loads((out / "training.json").read_text())
    config = GenerateConfig(task=args.task, split="eval", seed=0, cameras=())
    settings = settings_for(out, config, action=args.action)
    where = args.out / "evaluations" / out.name
    where.parent.mkdir(parents=True, exist_ok=True)
    found = evaluate(settings, where, num_episodes=args.scenes, workers=args.workers)
    print(f"{out.name:<40} {found.rate}", flush=True)
    made = Stage(
        arm=arm,
        corrected=corrected,
        demonstrations=count,
        frames=len(data.end),
        updates=updates,
        evaluation=found,
        cpu_seconds=training["cpu_seconds"],
    )
    return made, out


def stages(seed: int, args: argparse.Namespace) -> Iterator[Stage]:
    """All policies of one training seed."""
    plain = demonstrations(args, args.episodes)
    start, policy = stage("start", [plain], 0, seed, args)
    yield start
    datasets, done = [plain], 0
    for number in range(args.rounds):
        wanted = round(args.corrected * (number + 1) / args.rounds) - done
        out = args.out / "corrected" / f"{args.label}_{args.rules}_{seed}_{number}"
        scene_seed = CORRECTION_SEED + seed * args.rounds + number
        datasets.append(correct(policy, wanted, scene_seed, args, out))
        done += wanted
        corrected, policy = stage("corrected", datasets, done, seed, args)
        yield corrected
    more = demonstrations(args, args.episodes + args.corrected)
    yield stage("plain", [more], 0, seed, args)[0]


def rate(found: list[Stage]) -> Rate:
    """Success rate of all trainings of a row together."""
    rates = [s.evaluation.rate for s in found]
    return Rate(successes=sum(r.successes for r in rates), trials=sum(r.trials for r in rates))


def main() -> None:
    """Make the missing parts and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="pick_place")
    parser.add_argument("--episodes", type=int, default=100, help="plain demonstrations at the start")
    parser.add_argument("--corrected", type=int, default=100, help="corrected episodes in all")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--seeds", type=int, default=3, help="trainings, each with separate corrections")
    parser.add_argument("--first-seed", type=int, default=0, help="number of the first training")
    parser.add_argument("--workers", type=int, default=1, help="processes that run episodes")
    parser.add_argument("--scenes", type=int, default=150, help="held-out scenes of each policy")
    parser.add_argument("--action", default="ee_delta")
    parser.add_argument("--execute", type=int, default=16, help="actions of the chunk of 16 that are executed")
    parser.add_argument("--relative", action="store_true", help="hide absolute positions on the table")
    parser.add_argument("--no-velocities", dest="velocities", action="store_false", help="hide them: weaker policies")
    parser.add_argument("--steps", type=int, default=3000, help="updates for --episodes, in proportion for more")
    parser.add_argument("--batch-size", type=int, default=128)
    parser.add_argument("--learning-rate", type=float, default=5e-4)
    parser.add_argument("--stray-metres", type=float, default=TakeOver.stray_metres)
    parser.add_argument("--no-noise", dest="noise", action="store_false")
    parser.add_argument("--out", type=Path, default=Path("outputs/corrections"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.device = "cpu"
    args.variant = Variant(about="", action=args.action, execute=args.execute)
    args.hidden = (*([_ABSOLUTE] if args.relative else []), *([] if args.velocities else [_VELOCITIES]))
    args.label = f"{args.action}_{args.execute}_{args.steps}{'_relative' if args.relative else ''}"
    args.label += "" if args.velocities else "_no_velocities"
    args.rules = f"{args.stray_metres:g}{'' if args.noise else '_clean'}"
    args.out.mkdir(parents=True, exist_ok=True)
    rows: dict[tuple[str, int, int], list[Stage]] = defaultdict(list)
    started = time.process_time()
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        for made in stages(seed, args):
            rows[made.row].append(made)
    heads = f"{'arm':<10} {'plain':>6} {'corrected':>9} {'frames':>8} {'updates':>8} {'by training':>16}"
    print(f"\n{heads} {'train CPU s':>11}  success")
    for (arm, plain, corrected), found in rows.items():
        print(
            f"{arm:<10} {plain:>6} {corrected:>9} {np.mean([s.frames for s in found]):>8.0f} "
            f"{found[0].updates:>8} {' '.join(str(s.evaluation.rate.successes) for s in found):>16} "
            f"{np.mean([s.cpu_seconds for s in found]):>11.0f}  {rate(found)}"
        )
    print(f"CPU seconds of this process, workers not counted: {time.process_time() - started:.0f}")


if __name__ == "__main__":
    main()
