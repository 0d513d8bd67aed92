"""The drawing of docs/tasks.md: the hand's motion in each phase of one pick and place.

python benchmarks/phases.py
"""

from __future__ import annotations

import argparse
from itertools import groupby
from pathlib import Path

import matplotlib
import numpy as np

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.loop import ScriptAgent, Session, make_world, prepare

matplotlib.use("Agg")
from matplotlib import pyplot as plt

SKILLS = {
    "pick": ("perceive", "approach", "descend", "close", "lift"),
    "place": ("transport", "lower", "release", "retreat", "verify"),
}
COLORS = {"pick": "#dbe7f5", "place": "#e3f1de"}


def main() -> None:
    """Simulate one episode and draw it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "images" / "phases.png")
    out: Path = parser.parse_args().out
    episode = prepare(EpisodePlan(config=GenerateConfig(cameras=(), variation="none"), episode_index=0))
    with make_world(episode.info) as world:
        frames = list(Session.of_episode(world, episode).run(ScriptAgent(episode)))
    fps = episode.info.fps
    times = np.arange(len(frames)) / fps
    height = np.array([frame.observation.base_from_tcp.position[2] for frame in frames])
    width = np.array([frame.observation.gripper_width for frame in frames])
    phases = np.array([frame.phase for frame in frames])

    figure, (upper, lower) = plt.subplots(
        2, 1, sharex=True, figsize=(9.0, 3.6), dpi=110, height_ratios=(3, 1), layout="constrained"
    )
    upper.plot(times, 100 * height, color="#1f4e8c", linewidth=2)
    upper.set_ylabel("hand above\nthe table, cm")
    upper.set_ylim(0, 1.32 * 100 * height.max())
    lower.plot(times, 1000 * width, color="#a33c2f", linewidth=2)
    lower.set_ylabel("opening,\nmm")
    lower.set_ylim(0, 1.1 * 1000 * width.max())
    lower.set_xlabel("seconds")
    top = upper.get_ylim()[1]
    start = 0
    for phase, members in groupby(phases):
        end = start + len(list(members))
        skill = next(name for name, parts in SKILLS.items() if phase in parts)
        for axes in (upper, lower):
            axes.axvspan(start / fps, end / fps, facecolor=COLORS[skill], edgecolor="white", linewidth=1.5)
        label = {"ha": "center", "va": "top", "fontsize": 9, "rotation": 90 if end - start < 0.6 * fps else 0}
        upper.text((start + end) / 2 / fps, 0.97 * top, phase, **label)
        start = end
    for skill, parts in SKILLS.items():
        rows = np.flatnonzero(np.isin(phases, parts))
        middle = (rows[0] + rows[-1] + 1) / 2 / fps
        upper.text(middle, 1.02 * top, f"expert.{skill}", ha="center", va="bottom", family="monospace", fontsize=11)
    upper.set_xlim(0, len(frames) / fps)
    for axes in (upper, lower):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(out)
    print(f"{len(frames)} frames, phases {', '.join(dict.fromkeys(phases))}: {out}")


if __name__ == "__main__":
    main()
