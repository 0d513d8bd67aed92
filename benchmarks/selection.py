"""Train on all episodes of a dataset with bad demonstrations, and on those that `demorec check` calls good.

    python benchmarks/selection.py --out outputs/selection
    python benchmarks/selection.py --episodes 300 --bad 0.4 --steps 3000 --seeds 3 --scenes 100

A part of the generated episodes is spoilt in the exported dataset, written anew by LeRobot: the actions come late,
shake, are those of another episode, or the episode ends halfway. `demorec dataset select` leaves out what the doctor
does not call good. The policy, its training and its evaluation are those of learning.py.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np
from learning import ACTION, ENVIRONMENT, STATE, Variant, command, make_dataset, options_of, report
from numpy.typing import NDArray

KINDS = ("late", "shaky", "another episode's", "cut off")
LATE_FRAMES = 12
SHAKE_RATIO = 1.5
"""Noise of shaky actions, in standard deviations of the element over the episode."""
SELECTED = "verdict == 'good' and score > 0.5"

Columns = dict[str, NDArray[np.float32]]


def spoilt(kind: str, own: Columns, other: Columns, rng: np.random.Generator) -> Columns:
    """Spoil the (T, D) columns of one episode."""
    action = own[ACTION]
    if kind == "late":
        late = np.concatenate([np.repeat(action[:1], LATE_FRAMES, axis=0), action[:-LATE_FRAMES]])
        return {**own, ACTION: late}
    if kind == "shaky":
        noise = rng.normal(0, SHAKE_RATIO, action.shape) * action.std(axis=0)
        return {**own, ACTION: (action + noise).astype(np.float32)}
    if kind == "another episode's":
        rows = np.linspace(0, len(other[ACTION]) - 1, len(action)).astype(int)
        return {**own, ACTION: other[ACTION][rows]}
    return {name: values[: len(values) // 2] for name, values in own.items()}


def write_spoilt(source: Path, out: Path, ratio: float, seed: int) -> None:
    """Copy a dataset without images through LeRobot, with a ratio of its episodes spoilt, each kind equally often."""
    import datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    datasets.disable_progress_bars()
    dataset = LeRobotDataset("local/source", root=source)
    table = dataset.hf_dataset.with_format("numpy")
    names = (STATE, ENVIRONMENT, ACTION)
    owner = np.asarray(table["episode_index"])
    columns = {name: np.stack(list(table[name])).astype(np.float32) for name in names}
    episodes = [{name: columns[name][owner == number] for name in names} for number in np.unique(owner)]
    rng = np.random.default_rng(seed)
    bad = rng.permutation(len(episodes))[: round(ratio * len(episodes))]
    kind_of = {int(number): KINDS[place % len(KINDS)] for place, number in enumerate(bad)}
    made = LeRobotDataset.create(
        "local/spoilt",
        fps=dataset.fps,
        root=out,
        features={name: dataset.features[name] for name in names},
        robot_type=dataset.meta.robot_type,
        use_videos=False,
    )
    for number, own in enumerate(episodes):
        if number in kind_of:
            own = spoilt(kind_of[number], own, episodes[(number + 1) % len(episodes)], rng)
        for frame in range(len(own[ACTION])):
            made.add_frame(
                {**{name: values[frame] for name, values in own.items()}, "task": "Put the cube on the mark"}
            )
        made.save_episode()
    made.finalize()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bad", type=float, default=0.4, help="ratio of spoilt episodes")
    args = options_of(parser)
    variant = Variant(about="all episodes")
    label = f"{args.bad}_{args.episodes}"
    everything, selected = args.out / f"all_{label}", args.out / f"selected_{label}"
    if not everything.exists():
        unfinished = everything.with_suffix(".unfinished")
        shutil.rmtree(unfinished, ignore_errors=True)
        write_spoilt(make_dataset(variant, args), unfinished, args.bad, args.scene_seed)
        unfinished.rename(everything)
    if not selected.exists():
        command("demorec", "dataset", "select", everything, "--where", SELECTED, "--out", selected)
    rows = [("all", variant, everything), ("selected", Variant(about=f"those with {SELECTED}"), selected)]
    report(rows, args)


if __name__ == "__main__":
    main()
