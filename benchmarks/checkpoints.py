"""How a training went: every checkpoint of lerobot-train or demorec train tried on held-out scenes, and where it fails.

    demorec train --config_path=examples/act_images.json 2>&1 | tee outputs/act_images.log
    python benchmarks/checkpoints.py outputs/act_images --scenes 50 --last 100 --plot outputs/act_images.png \\
        --log outputs/act_images.log

Each checkpoint is one row: strict success with its 95 % interval, and the loss that the log tells of the updates before
it. The last one is also cut by cell of the randomised ranges. Evaluations are those of `demorec evaluate`, kept below
--out; the same command goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import json
import re
from dataclasses import dataclass
from pathlib import Path

from demorec.core.config import GenerateConfig
from demorec.core.processes import available_cores
from demorec.learn.evaluate.rollouts import Evaluation, evaluate, settings_for
from demorec.learn.evaluate.statistics import cells


@dataclass(frozen=True, kw_only=True)
class Tried:
    """A checkpoint: how many updates it has had, and how it did."""

    updates: int
    evaluation: Evaluation


def losses(log: Path, every: int) -> list[tuple[int, float]]:
    """(update, mean loss since the point before): the log rounds the updates that it tells."""
    found = re.findall(r"step:\S+ .*?\bloss:(\S+)", log.read_text(errors="replace"))
    return [(every * (number + 1), float(loss)) for number, loss in enumerate(found)]


def plot(tried: list[Tried], curve: list[tuple[int, float]], path: Path) -> None:
    """Loss and success over updates; success of the last checkpoint by cell of the ranges."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(11, 7.2), layout="constrained")
    grid = figure.add_gridspec(2, 2)
    success, loss, bars = (figure.add_subplot(place) for place in (grid[0, 0], grid[0, 1], grid[1, :]))
    rates = [each.evaluation.rate for each in tried]
    values = [100 * rate.value for rate in rates]
    spans = [
        (value - 100 * rate.interval[0], 100 * rate.interval[1] - value)
        for value, rate in zip(values, rates, strict=True)
    ]
    updates = [each.updates for each in tried]
    success.errorbar(updates, values, yerr=list(zip(*spans, strict=True)), marker="o", capsize=3)
    success.set_ylim(0, 102)
    success.set_xlabel("updates")
    success.set_ylabel("solved, % (bar: 95 % interval)")
    if curve:
        loss.plot(*zip(*curve, strict=True))
        loss.set_yscale("log")
    loss.set_xlabel("updates")
    loss.set_ylabel("loss (L1, normalised actions)")
    last = tried[-1].evaluation
    parts = cells(last.factors, [bool(rollout.success) for rollout in last.rollouts])
    bars.bar(range(len(parts)), [100 * part.rate.value for part in parts], color="C0")
    names = [f"{part.factor} {part.low:.3g}..{part.high:.3g} ({part.rate.trials})" for part in parts]
    bars.set_xticks(range(len(parts)), names, rotation=90, fontsize=6.5)
    bars.set_ylim(0, 102)
    bars.set_ylabel(f"solved after {tried[-1].updates} updates, %")
    for axes in (success, loss, bars):
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Try the checkpoints and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("training", type=Path, help="output folder of the training")
    parser.add_argument("--task", default="pick_place")
    parser.add_argument("--split", default="eval", choices=("all", "train", "eval"))
    parser.add_argument("--scene-seed", type=int, default=0)
    parser.add_argument("--scenes", type=int, default=50, help="of each checkpoint but the last one")
    parser.add_argument("--last", type=int, default=100, help="scenes of the last checkpoint")
    parser.add_argument(
        "--action-steps", type=int, help="actions executed before it looks again; as trained by default"
    )
    parser.add_argument("--workers", type=int, default=available_cores())
    parser.add_argument("--log", type=Path, help="what the training printed")
    parser.add_argument("--out", type=Path, help="of the evaluations; evaluations/ beside the checkpoints by default")
    parser.add_argument("--plot", type=Path, help="also draw the table into this PNG")
    args = parser.parse_args()
    out = args.out or args.training / "evaluations"
    checkpoints = sorted(path for path in (args.training / "checkpoints").iterdir() if path.name.isdigit())
    tried, curve = [], []
    if args.log is not None:
        settings = json.loads((checkpoints[-1] / "pretrained_model" / "train_config.json").read_text())
        curve = losses(args.log, int(settings["log_freq"]))
    print(f"{'updates':>8} {'loss':>7}  success", flush=True)
    for checkpoint in checkpoints:
        config = GenerateConfig(task=args.task, split=args.split, seed=args.scene_seed, cameras=())
        found = evaluate(
            settings_for(checkpoint, config, action_steps=args.action_steps),
            out / f"{checkpoint.name}_{args.split}_{args.scene_seed}_{args.action_steps or 'trained'}",
            num_episodes=args.last if checkpoint == checkpoints[-1] else args.scenes,
            workers=args.workers,
        )
        tried.append(Tried(updates=int(checkpoint.name), evaluation=found))
        told = [loss for update, loss in curve if update <= tried[-1].updates]
        print(f"{tried[-1].updates:>8} {told[-1] if told else float('nan'):>7.3f}  {found.rate}", flush=True)
    for part in cells(tried[-1].evaluation.factors, [bool(r.success) for r in tried[-1].evaluation.rollouts]):
        print(f"{part.factor:<20} {part.low:.3f} .. {part.high:.3f}  {part.rate}")
    if args.plot is not None:
        plot(tried, curve, args.plot)


if __name__ == "__main__":
    main()
