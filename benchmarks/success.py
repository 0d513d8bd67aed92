"""Success of the expert, without images: strict success, first attempts, failures by phase and reason, speed.

    python benchmarks/success.py --episodes 500
    python benchmarks/success.py --tasks pick_place --robots panda --episodes 300 --json out.json
    python benchmarks/success.py --tasks pick_anything --objects household blocks random --episodes 2000

Speed is per core and based on process CPU time, so that it can be compared on a shared machine.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.errors import ConfigError, SceneError
from demorec.core.tables import ROBOTS, TASKS
from demorec.episode.episode import Outcome
from demorec.loop import ScriptAgent, Session, make_world, prepare


def measure(config: GenerateConfig, *, first: int, episodes: int) -> dict[str, Any]:
    """Run episodes first .. first + episodes - 1 of a config and sum them up."""
    outcomes: dict[int, Outcome] = {}
    things: dict[int, str] = {}
    unplaceable: list[int] = []
    warm_up = prepare(EpisodePlan(config=config, episode_index=first))
    with make_world(warm_up.info) as world:
        for _ in Session.of_episode(world, warm_up).run(ScriptAgent(warm_up)):  # compiles the kinematics
            pass
        started = time.process_time()
        for index in range(first, first + episodes):
            try:
                episode = prepare(EpisodePlan(config=config, episode_index=index))
            except SceneError:
                unplaceable.append(index)
                continue
            session = Session.of_episode(world, episode)
            for _ in session.run(ScriptAgent(episode)):
                pass
            outcomes[index] = session.outcome
            things[index] = episode.info.simulated.scene.goals[0].object if episode.info.simulated.scene.goals else ""
        seconds = time.process_time() - started
    done = list(outcomes.values())
    successes = [outcome for outcome in done if outcome.success]
    distances = sorted(
        check.value for outcome in successes for check in outcome.checks if check.name.startswith("distance_to_goal")
    )
    return {
        "task": config.task,
        "robot": config.robot,
        "variation": config.variation,
        "episodes": episodes,
        "success": len(successes),
        "first_try": sum(outcome.num_retries == 0 for outcome in successes),
        "failures": dict(Counter(f"{o.failure_phase}: {o.failure_reason}" for o in done if not o.success)),
        "failed_episodes": {index: things[index] for index, outcome in outcomes.items() if not outcome.success},
        "not_at_first": {index: things[index] for index, outcome in outcomes.items() if outcome.num_retries},
        "of_kind": dict(Counter(name.rpartition("_")[2] for name in things.values())),
        "no_layout": unplaceable,
        "frames": sum(outcome.num_frames for outcome in done) / max(1, len(done)),
        "distance_mm": [1000 * distances[round(q * (len(distances) - 1))] for q in (0.5, 0.95, 1.0)]
        if distances
        else [],
        "episodes_per_minute_per_core": 60 * episodes / seconds,
    }


def table_row(row: dict[str, Any]) -> str:
    """One line of the table."""
    distance = " / ".join(f"{value:.2f}" for value in row["distance_mm"])
    return (
        f"| {row['task']} | {row['robot']} | {row['variation']} | {row['success']}/{row['episodes']} "
        f"({100 * row['success'] / row['episodes']:.2f} %) | {row['first_try']} | {row['frames']:.0f} | {distance} | "
        f"{row['episodes_per_minute_per_core']:.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["pick_place"], help="names, or all")
    parser.add_argument("--robots", nargs="+", default=["panda"], help="names, or all")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="index of the first episode")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variations", nargs="+", default=["mild"], choices=["none", "mild", "full"])
    parser.add_argument("--objects", nargs="+", default=[], help="shelves of pick_anything")
    parser.add_argument("--json", type=Path, help="write the figures here too")
    args = parser.parse_args()
    rows = []
    print(
        "| task | robot | variation | strict success | first try | frames | mm from goal (median / p95 / max) "
        "| episodes/min/core |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for task in TASKS.names() if args.tasks == ["all"] else args.tasks:
        for robot in ROBOTS.names() if args.robots == ["all"] else args.robots:
            for variation in args.variations:
                config = GenerateConfig(
                    task=task,
                    robot=robot,
                    seed=args.seed,
                    variation=variation,
                    cameras=(),
                    objects=tuple(args.objects),
                )
                try:
                    config.validate()
                except ConfigError as error:
                    parser.error(str(error))
                row = measure(config, first=args.first, episodes=args.episodes)
                rows.append(row)
                print(table_row(row), flush=True)
                for reason, count in sorted(row["failures"].items()):
                    print(f"    {count} x {reason}")
                if row["failed_episodes"] or row["no_layout"]:
                    print(f"    failed episodes {row['failed_episodes']}, no layout {row['no_layout']}")
                if args.objects:
                    print(f"    not at the first try {row['not_at_first']}, episodes of each kind {row['of_kind']}")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
