"""Does curation make better policies: ACT trained on a run with spoilt demonstrations, on what the score selects of it,
and on as many sound ones.

    python benchmarks/curated.py --out outputs/curated
    python benchmarks/curated.py --out outputs/curated --plot curated.png

Demonstrations with another thing on the table, of which 30 in 100 are spoilt in the eight ways of
benchmarks/curation.py: some larger, as people's may be (pauses of 2 to 6 s, actions 0.2 to 0.6 s late, labels off by
0.01 to 0.04 rad in every frame), and the wrong object is really taken. They are recorded and exported with the
product's own means. `demorec dataset score` sees joint targets and two small cameras, ACT the joints,
`observation.environment_state` (with what was asked for) and `ee_delta`. It learns as in benchmarks/learning.py and
acts in scenes of `--split eval`. Nothing says to the score what was spoilt. What is there
already in --out is used again.
"""

from __future__ import annotations

import argparse
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from curation import CAMERAS, FPS, HEIGHT, KINDS, SIMULATED, SPOILT, WIDTH, Clumsy, auc
from learning import ACTION, ENVIRONMENT, STATE, Data, Variant, command, statistics, train
from numpy.typing import NDArray

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.errors import SceneError
from demorec.core.processes import in_turn
from demorec.episode.episode import Action, Frame, Outcome
from demorec.episode.features import action_vectors, observation_vectors
from demorec.episode.info import EpisodeInfo
from demorec.episode.sensed import ObservationRows
from demorec.episode.variation import Ranges
from demorec.learn.evaluate.rollouts import evaluate, settings_for
from demorec.learn.evaluate.statistics import Rate
from demorec.loop import Episode, ScriptAgent, Session, SimulatorCache, prepare
from demorec.mcap import EpisodeWriter, Recording
from demorec.robots.kinematics import ArmKinematics

SEED, ATTEMPTS = 31, 40
THINGS = Ranges(distractors=(1, 1))
PAUSE, LATE, NOISE = (2.0, 6.0), (0.2, 0.6), (0.01, 0.04)
"""Of hesitations and late actions, seconds; standard deviations of the noise in labels, rad."""
SOUND = 0.8
"""Above it an episode is selected, as docs/datasets.md has it."""
CHOICES = ("all", "selected", "sound")
_caches: list[SimulatorCache] = []


def record(job: tuple[str, int, int, str, Path]) -> None:
    """One demonstration, with what shall be wrong with it ("" for nothing), into a file; none where one is there."""
    task, seed, index, kind, path = job
    if path.exists():
        return
    if not _caches:
        _caches.append(SimulatorCache())
    config = GenerateConfig(
        task=task, seed=seed, split="train", fps=FPS, width=WIDTH, height=HEIGHT, cameras=CAMERAS, ranges=THINGS
    )
    for attempt in range(ATTEMPTS):
        try:
            episode = prepare(EpisodePlan(config=config, episode_index=index, attempt=attempt))
        except SceneError:
            continue
        told = episode.info
        if kind == "wrong object":
            episode = with_other_goal(episode)
        world, renderer = _caches[0].acquire(told)
        session = Session.of_episode(world, episode, renderer)
        agent: Any = ScriptAgent(episode)
        rng = np.random.default_rng([seed, index])
        if kind in SIMULATED:
            agent = Clumsy(agent, kind, rng, PAUSE)
        frames = list(session.run(agent))
        if agent.happened if kind in SIMULATED else session.outcome.success:
            write(path, told, spoilt(frames, kind, rng, world.arm.kinematics))
            return
    raise SystemExit(f"No attempt at episode {index} became {kind or 'sound'}.")


def with_other_goal(episode: Episode) -> Episode:
    """The other thing to where the cube belongs."""
    scene = episode.info.scene
    (other,) = (body.name for body in scene.bodies if body.role == "distractor")
    scene = replace(scene, goals=(replace(scene.goals[0], object=other),))
    return replace(episode, info=episode.info.with_simulation(scene=scene))


def write(path: Path, info: EpisodeInfo, frames: Sequence[Frame]) -> None:
    """Record frames as a demonstration that whoever made it took for a success."""
    with EpisodeWriter(path, info) as recording:
        for frame in frames:
            recording.write(frame)
        recording.finish(Outcome(success=True, num_frames=len(frames), final_state_digest="0" * 64))


def spoilt(frames: list[Frame], kind: str, rng: np.random.Generator, arm: ArmKinematics) -> list[Frame]:
    """The frames with what is not simulated: labels, images or the end changed."""
    count = len(frames)
    match kind:
        case "label noise":
            shape = (count, len(frames[0].action.joint_target))
            pairs = zip(frames, rng.normal(scale=rng.uniform(*NOISE), size=shape), strict=True)
            return [with_labels(f, off(f.action, n, arm), off(f.command, n, arm)) for f, n in pairs]
        case "late actions":
            late = round(float(rng.uniform(*LATE)) * FPS)
            before = [frames[max(0, t - late)] for t in range(count)]
            return [with_labels(f, b.action, b.command) for f, b in zip(frames, before, strict=True)]
        case "frozen camera":
            begin, seconds = int(rng.uniform(0.1, 0.6) * count), float(rng.uniform(1.0, 4.0))
            camera, end = str(rng.choice(CAMERAS)), begin + round(seconds * FPS)
            still = frames[begin].images[camera]
            return [
                replace(f, images={**f.images, camera: still}) if begin <= t < end else f for t, f in enumerate(frames)
            ]
        case "cut end":
            return frames[: round(count * float(rng.uniform(0.55, 0.85)))]
    return frames


def with_labels(frame: Frame, action: Action, command: Action) -> Frame:
    return replace(frame, action=action, command=command)


def off(action: Action, offset: NDArray[np.float64], arm: ArmKinematics) -> Action:
    """The action with its joint targets beside where they were."""
    target = action.joint_target + offset
    return replace(action, joint_target=target, base_from_tcp_target=arm.forward(target))


def kinds_of(episodes: int, seed: int) -> list[str]:
    """What is wrong with each episode, "" for nothing: as many of each kind, in random order."""
    count = round(SPOILT * episodes)
    kinds = [KINDS[number % len(KINDS)] for number in range(count)] + [""] * (episodes - count)
    return [str(kind) for kind in np.random.default_rng(seed).permutation(kinds)]


def scores_of(args: argparse.Namespace, kinds: Sequence[str]) -> list[float]:
    """Record what is not there yet, export it, and score each episode."""
    out = args.out
    run, seen, scores = out / "run", out / "seen", out / "scores.json"
    run.mkdir(parents=True, exist_ok=True)
    jobs = [(args.task, args.seed, index, kind, run / f"{index:04d}.mcap") for index, kind in enumerate(kinds)]
    for _ in in_turn(record, jobs, args.workers):
        pass
    if not seen.exists():
        command("demorec", "export", "lerobot", run, "--out", seen, "--action", "joint")
    if not scores.exists():
        command("demorec", "dataset", "score", seen, "--out", scores)
    return [row["score"] for row in json.loads(scores.read_text())["episodes"]]


def numbers_of(run: Path) -> list[dict[str, torch.Tensor]]:
    """What ACT learns of each recording: one dataset would refuse them, whose cubes differ in colour."""
    found = []
    for path in sorted(run.glob("*.mcap")):
        with Recording(path) as recording:
            info, columns = recording.info, recording.columns()
        rows = ObservationRows.of_columns(columns)
        vectors = observation_vectors(rows, info.robot, info.scene, privileged=True)
        vectors[ACTION] = action_vectors(columns, info.scene, "ee_delta")
        found.append({name: torch.from_numpy(vectors[name]) for name in (STATE, ENVIRONMENT, ACTION)})
    return found


def data_of(episodes: Sequence[dict[str, torch.Tensor]]) -> Data:
    """Some episodes for benchmarks/learning.py."""
    columns = {name: torch.cat([each[name] for each in episodes]) for name in episodes[0]}
    sizes = torch.tensor([len(each[ACTION]) for each in episodes])
    end = torch.repeat_interleave(torch.cumsum(sizes, 0), sizes)
    return Data(columns=columns, end=end, stats={name: statistics(values) for name, values in columns.items()})


def chosen(kinds: Sequence[str], scores: Sequence[float], seed: int) -> dict[str, list[int]]:
    """Name -> episodes that are learned from."""
    selected = [number for number, score in enumerate(scores) if score > SOUND]
    sound = [number for number, kind in enumerate(kinds) if not kind]
    few = np.random.default_rng(seed).permutation(sound)[: len(selected)]
    return dict(zip(CHOICES, (list(range(len(kinds))), selected, sorted(few.tolist())), strict=True))


def learned(name: str, numbers: Sequence[int], args: argparse.Namespace) -> Rate:
    """Success of ACT on some episodes, over all trainings; what was trained or tried before is not done again."""
    variant = Variant(about="", action="ee_delta", execute=8)
    config = GenerateConfig(task=args.task, split="eval", cameras=(), fps=FPS, ranges=THINGS)
    results = []
    for seed in range(args.seeds):
        policy = args.out / "policies" / f"{name}_{args.steps}_{seed}"
        if not (policy / "training.json").exists():
            episodes = numbers_of(args.out / "run")
            train(data_of([episodes[number] for number in numbers]), variant, args, seed=seed, out=policy)
        where = args.out / "evaluations" / policy.name
        where.parent.mkdir(exist_ok=True)
        settings = settings_for(policy, config, action=variant.action)  # type: ignore[arg-type]
        results.append(evaluate(settings, where, num_episodes=args.scenes, workers=args.workers).rate)
    rate = Rate(successes=sum(r.successes for r in results), trials=sum(r.trials for r in results))
    low, high = rate.interval
    by = ", ".join(str(r.successes) for r in results)
    print(f"{name:9} {len(numbers):4} episodes: {rate.successes}/{rate.trials}, {100 * low:.0f} to {100 * high:.0f} %, "
          f"by training {by}", flush=True)  # fmt: skip
    return rate


def plot(rates: Mapping[str, Rate], kinds: Sequence[str], scores: Sequence[float], path: Path) -> None:
    """Scores by kind, and success of each choice with its 95 % interval."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.4), width_ratios=(3, 2), layout="constrained")
    rng = np.random.default_rng(0)
    for row, kind in enumerate(("", *KINDS)):
        own = [score for score, other in zip(scores, kinds, strict=True) if other == kind]
        left.plot(own, row + rng.uniform(-0.3, 0.3, len(own)), ".", color="C3" if kind else "C0", markersize=4)
    left.axvline(SOUND, color="black", linewidth=0.8)
    left.set_yticks(range(1 + len(KINDS)), ["sound", *KINDS], fontsize=8)
    left.invert_yaxis()
    left.set_xlabel("score of each demonstration (line: what is selected)")
    for row, rate in enumerate(rates.values()):
        low, high = rate.interval
        right.barh(row, 100 * rate.successes / rate.trials, color=f"C{row}", height=0.6)
        right.plot([100 * low, 100 * high], [row, row], color="black", linewidth=1.2)
    right.set_yticks(range(len(rates)), [f"{n}\n{r.successes} of {r.trials}" for n, r in rates.items()], fontsize=8)
    right.invert_yaxis()
    right.set_xlim(0, 100)
    right.set_xlabel("success in held-out scenes, % (line: 95 % interval)")
    for axes in (left, right):
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for episodes, datasets and policies")
    parser.add_argument("--task", default="pick_place")
    parser.add_argument("--seed", type=int, default=SEED, help="of the demonstrations and of what is spoilt")
    parser.add_argument("--episodes", type=int, default=320)
    parser.add_argument("--only", nargs="*", default=CHOICES, choices=CHOICES, help="what is learned from; may be none")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--batch-size", type=int, default=128)
    parser.add_argument("--learning-rate", type=float, default=5e-4)
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each")
    parser.add_argument("--scenes", type=int, default=150, help="held-out scenes of each training")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--plot", type=Path, help="draw scores and success into this image")
    args = parser.parse_args()
    args.device = "cpu"
    torch.set_num_threads(1)
    kinds = kinds_of(args.episodes, args.seed)
    scores = scores_of(args, kinds)
    good = [score for score, kind in zip(scores, kinds, strict=True) if not kind]
    bad = [score for score, kind in zip(scores, kinds, strict=True) if kind]
    kept = Counter(kind for kind, score in zip(kinds, scores, strict=True) if score > SOUND)
    told = [f"{kept[kind]} of {kinds.count(kind)} {kind or 'sound'}" for kind in ("", *KINDS)]
    print(f"AUC {auc(good, bad):.3f}; selected: {', '.join(told)}", flush=True)
    found = chosen(kinds, scores, args.seed)
    rates = {name: learned(name, found[name], args) for name in args.only}
    if args.plot is not None:
        plot(rates, kinds, scores, args.plot)


if __name__ == "__main__":
    main()
