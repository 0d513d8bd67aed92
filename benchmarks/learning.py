"""Compare variants of the training data: the same policy, trained on each and evaluated in held-out scenes.

    python benchmarks/learning.py --variants base clean plain_increments --out outputs/learning
    python benchmarks/learning.py --episodes 1000 --steps 8000 --scenes 100 --seeds 3
    python benchmarks/learning.py --variants joint_state joint_ee_state --episodes 300 --steps 3000 --scenes 60

Every variant is made with demorec's commands (generate-dataset, demorec export lerobot, demorec evaluate). Training is
LeRobot's ACT class with the numbers of a dataset held in memory: lerobot-train reads them row by row and spends five
sixths of its CPU time there; the network, the loss and the optimizer are the same. One thread, no download. Each
variant is one row: strict success in closed loop with its 95 % interval, and CPU seconds of training. Existing runs,
datasets, policies and evaluations in --out are reused.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray

STATE, ENVIRONMENT, ACTION = "observation.state", "observation.environment_state", "action"
SWITCHED_OFF = 1e9
"""Standard deviation that hides a component from a policy: normalising with it leaves only zeros."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way to make data or to learn from it.

    Attributes:
        about: Difference from the base.
        generate: Flags of generate-dataset.
        action: Value of --action in demorec export lerobot.
        plain: Remove the recovery from noise from the increments.
        see: Pattern of the components of the environment state that are not hidden; "" for all.
        execute: Actions of the chunk that are executed before the next observation.
    """

    about: str
    generate: tuple[str, ...] = ()
    action: str = "joint_increment"
    plain: bool = False
    see: str = ""
    execute: int = 16


CHUNK = 16
"""Actions predicted at once."""
THINGS = r"red_cube\.([xyz]|size\.[xyz]|yaw\.\w+|goal\.[xyz])"
"""Components that perfect vision would give: positions of cube and mark."""
VARIANTS = {
    "base": Variant(about="noise 0.02 rad, clean labels, increments, all of the state, 16 of 16 executed"),
    "clean": Variant(about="no action noise", generate=("--action-noise", "0", "0")),
    "plain_increments": Variant(about="increments without the recovery from noise", plain=True),
    "joint": Variant(about="absolute joint targets", action="joint"),
    "ee_delta": Variant(about="TCP deltas", action="ee_delta"),
    "joint_state": Variant(
        about="TCP deltas; poses of cube and mark and the joints alone", action="ee_delta", see=THINGS
    ),
    "joint_ee_state": Variant(
        about="the same, and the TCP's position and yaw", action="ee_delta", see=rf"{THINGS}|tcp\..*"
    ),
}


@dataclass(eq=False, kw_only=True)
class Data:
    """All frames of a dataset, in memory, and its statistics."""

    columns: dict[str, torch.Tensor]
    end: torch.Tensor  # (N,) index after the last frame of each frame's episode
    stats: dict[str, dict[str, torch.Tensor]]


def command(*words: str | Path) -> None:
    """Run one of demorec's commands; its output only if it fails."""
    program = Path(sys.executable).with_name(str(words[0]))
    result = subprocess.run([program, *map(str, words[1:])], capture_output=True, text=True, check=False)
    if result.returncode:
        raise SystemExit(f"{' '.join(map(str, words))}\n{result.stdout}{result.stderr}")


def make_dataset(variant: Variant, args: argparse.Namespace) -> Path:
    """Generate and export, unless done before."""
    label = "_".join(word.strip("-").replace(".", "") for word in variant.generate) or "base"
    run = args.out / f"run_{label}_{args.episodes}"
    command(
        *("generate-dataset", "--out", run, "--task", args.task, "--num-episodes", str(args.episodes)),
        *("--split", "train", "--workers", str(args.workers), "--no-export", "--cameras", "none", *variant.generate),
    )
    dataset = run / f"dataset_{variant.action}"
    if not dataset.exists():
        command(
            *("demorec", "export", "lerobot", run, "--out", dataset, "--action", variant.action),
            *("--episodes", f"0:{args.episodes}", "--privileged"),
        )
    return Path(dataset)


def load(dataset: Path, variant: Variant) -> Data:
    """Read a dataset's numbers and apply the variant's hidden components."""
    info = json.loads((dataset / "meta" / "info.json").read_text())
    tables = [pq.read_table(path) for path in sorted((dataset / "data").rglob("*.parquet"))]
    columns = {
        name: torch.from_numpy(np.concatenate([np.stack(t[name].to_numpy()) for t in tables]).astype(np.float32))
        for name in (STATE, ACTION, ENVIRONMENT)
    }
    episode = np.concatenate([t["episode_index"].to_numpy() for t in tables])
    if variant.plain:
        columns[ACTION] = torch.from_numpy(plain_increments(dataset))
    stats = {name: statistics(values) for name, values in columns.items()}
    for i, component in enumerate(info["features"][ENVIRONMENT]["names"]):
        if not re.fullmatch(variant.see or ".*", component):
            stats[ENVIRONMENT]["std"][i] = SWITCHED_OFF
    return Data(columns=columns, end=torch.from_numpy(np.searchsorted(episode, episode, side="right")), stats=stats)


def statistics(values: torch.Tensor) -> dict[str, torch.Tensor]:
    """Mean and standard deviation of every component."""
    wide = values.double()
    return {"mean": wide.mean(0).float(), "std": wide.std(0, unbiased=False).float()}


def plain_increments(dataset: Path) -> NDArray[np.float32]:
    """Increments of the clean targets alone, from the same recordings."""
    from demorec.mcap import Recording

    rows = []
    count = json.loads((dataset / "meta" / "info.json").read_text())["total_episodes"]
    for path in sorted((dataset.parent / "episodes").glob("*.mcap"))[:count]:
        with Recording(path) as recording:
            trajectory, start = recording.trajectory(), recording.info.simulated.scene.robot.joint_position
        increments = np.diff(trajectory.action_joint_target, axis=0, prepend=np.array([start]))
        rows.append(np.concatenate([increments, trajectory.action_gripper[:, None]], axis=1))
    return np.asarray(np.concatenate(rows), dtype=np.float32)


def train(data: Data, variant: Variant, args: argparse.Namespace, *, seed: int, out: Path) -> float:
    """Train LeRobot's ACT and save it as lerobot-train does; returns CPU seconds."""
    from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.act.processor_act import make_act_pre_post_processors

    kinds = {STATE: FeatureType.STATE, ENVIRONMENT: FeatureType.ENV, ACTION: FeatureType.ACTION}
    inputs = {
        name: PolicyFeature(kinds[name], tuple(values.shape[1:]))
        for name, values in data.columns.items()
        if name != ACTION
    }
    torch.manual_seed(seed)
    policy = ACTPolicy(
        ACTConfig(
            use_vae=False,
            dropout=0.0,
            dim_model=128,
            n_heads=4,
            dim_feedforward=512,
            n_encoder_layers=2,
            chunk_size=CHUNK,
            n_action_steps=variant.execute,
            pretrained_backbone_weights=None,
            device=args.device,
            push_to_hub=False,
            normalization_mapping=dict.fromkeys(("STATE", "ENV", "ACTION"), NormalizationMode.MEAN_STD),
            input_features=inputs,
            output_features={ACTION: PolicyFeature(FeatureType.ACTION, tuple(data.columns[ACTION].shape[1:]))},
        )
    ).to(args.device)
    before, after = make_act_pre_post_processors(policy.config, data.stats)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=args.learning_rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: min(1.0, (step + 1) / 100) * 0.5 * (1 + math.cos(math.pi * step / args.steps))
    )
    generator = torch.Generator().manual_seed(seed)
    count = len(data.end)
    policy.train()
    started = time.process_time()
    for _ in range(args.steps):
        rows = torch.randint(count, (args.batch_size,), generator=generator)
        ahead = rows[:, None] + torch.arange(CHUNK)
        last = data.end[rows][:, None] - 1
        batch = {name: values[rows] for name, values in data.columns.items()}
        batch[ACTION] = data.columns[ACTION][torch.minimum(ahead, last)]
        batch = before(batch)
        batch["action_is_pad"] = (ahead > last).to(args.device)
        loss, _ = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
        optimizer.step()
        schedule.step()
    seconds = time.process_time() - started
    policy.save_pretrained(out)
    before.save_pretrained(out)
    after.save_pretrained(out)
    (out / "training.json").write_text(json.dumps({"cpu_seconds": seconds}, indent=1))
    return seconds


def measure(name: str, variant: Variant, dataset: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Measure one row of the table."""
    from demorec.core.config import GenerateConfig
    from demorec.extensions.policies.rollouts import evaluate, settings_for
    from demorec.extensions.policies.statistics import Rate

    data: Data | None = None
    results = []
    for seed in range(args.seeds):
        out = args.out / "policies" / f"{name}_{args.episodes}_{args.steps}_{seed}"
        if not (out / "training.json").exists():
            data = data or load(dataset, variant)
            train(data, variant, args, seed=seed, out=out)
        config = GenerateConfig(task=args.task, split=args.split, seed=args.scene_seed, cameras=())
        settings = settings_for(out, config, action=variant.action)  # type: ignore[arg-type]
        where = args.out / "evaluations" / f"{out.name}_{args.split}_{args.scene_seed}"
        where.parent.mkdir(parents=True, exist_ok=True)
        results.append(evaluate(settings, where, num_episodes=args.scenes, workers=args.workers).rate)
    total = Rate(successes=sum(r.successes for r in results), trials=sum(r.trials for r in results))
    seconds = [
        json.loads((args.out / "policies" / f"{name}_{args.episodes}_{args.steps}_{s}" / "training.json").read_text())
        for s in range(args.seeds)
    ]
    low, high = total.interval
    return {
        "variant": name,
        "about": variant.about,
        "success": total.successes,
        "trials": total.trials,
        "low": low,
        "high": high,
        "by_seed": [r.successes for r in results],
        "train_cpu_seconds": float(np.mean([s["cpu_seconds"] for s in seconds])),
    }


def options_of(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Add the flags of training and evaluation, and parse all."""
    parser.add_argument("--task", default="pick_place")
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--batch-size", type=int, default=128)
    parser.add_argument("--learning-rate", type=float, default=5e-4)
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each variant")
    parser.add_argument("--scenes", type=int, default=50, help="held-out scenes of each training")
    parser.add_argument("--split", default="eval", choices=("all", "train", "eval"))
    parser.add_argument("--scene-seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("outputs/learning"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    return args


def report(variants: Iterable[tuple[str, Variant, Path]], args: argparse.Namespace) -> None:
    """Measure name, variant and dataset of each row, and print the table."""
    rows = []
    print(f"{'variant':<18} {'success':>9} {'95 % interval':>16} {'train CPU s':>12}  about", flush=True)
    for name, variant, dataset in variants:
        row = measure(name, variant, dataset, args)
        rows.append(row)
        interval = f"[{100 * row['low']:.0f}, {100 * row['high']:.0f}] %"
        print(
            f"{name:<18} {row['success']:>4}/{row['trials']:<4} {interval:>16} {row['train_cpu_seconds']:>12.0f}  "
            f"{row['about']}",
            flush=True,
        )
    (args.out / "learning.json").write_text(json.dumps(rows, indent=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variants", nargs="+", default=["base", "clean"], choices=list(VARIANTS))
    args = options_of(parser)
    report(((name, VARIANTS[name], make_dataset(VARIANTS[name], args)) for name in args.variants), args)


if __name__ == "__main__":
    main()
