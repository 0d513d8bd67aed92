"""LeRobot's language columns of all tasks, verified by LeRobot, by the recordings' phases and by brute force."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.check import simulate_run
from support.export import data_table, episode_rows, export, files_of
from support.language import active, language_of, meant, phrases, scene_at

from demorec.core.errors import ConfigError
from demorec.core.geometry import Pose
from demorec.core.tables import TASKS
from demorec.datasets.lerobot.options import KINDS
from demorec.episode.scene import Body, Shape
from demorec.episode.variation import Ranges
from demorec.episode.words import NOUNS
from demorec.extensions.datasets.inspect import dataset_digest
from demorec.extensions.language.progress import StageRun, dense_runs, dense_stages, proportions
from demorec.extensions.language.referring import nouns_of, place_of
from demorec.extensions.language.timeline import episode_timeline
from demorec.extensions.tasks.pick import THINGS
from demorec.mcap import Recording

RECIPE = Path(__file__).parents[2] / "examples" / "language_recipe.yaml"
MISSING = ("pick_place", "stack", "sort_by_color")
"""Tasks whose episode begins with a deliberate miss."""
PLAIN = Ranges(miss_probability=0.0)

pytestmark = [pytest.mark.usefixtures("hf_datasets_cache"), pytest.mark.slow]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A run of one episode of every task, numbers only."""
    folder = tmp_path_factory.mktemp("runs")
    return [
        simulate_run(
            folder / task, 1, task=task, seed=3, cameras=(),
            ranges=Ranges(miss_probability=1.0) if task in MISSING else PLAIN,
        )
        for task in TASKS.names()
    ]  # fmt: skip


@pytest.fixture(scope="module")
def dataset(runs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All episodes in one dataset, with every kind of language."""
    out = tmp_path_factory.mktemp("dataset") / "all"
    report = export(runs, out, language=(), progress=True)
    assert report.digest == dataset_digest(out)
    return out


def _recording(run: Path) -> Recording:
    (path,) = (run / "episodes").glob("*.mcap")
    return Recording(path)


def test_lerobots_own_validator_finds_nothing(dataset: Path, tmp_path: Path) -> None:
    from lerobot.annotations.steerable_pipeline.reader import iter_episodes
    from lerobot.annotations.steerable_pipeline.staging import EpisodeStaging
    from lerobot.annotations.steerable_pipeline.validator import StagingValidator
    from lerobot.datasets.language import column_for_style, validate_camera_field

    spoken = language_of(dataset)
    records = list(iter_episodes(dataset))
    assert len(records) == len(spoken) == len(TASKS.names())
    for record, frames in zip(records, spoken, strict=True):
        persistent = frames[0][0]
        assert all(rows == persistent and events == [] for rows, events in frames)
        assert {row["style"] for row in persistent} == set(KINDS)
        for row in persistent:
            assert column_for_style(row["style"]) == "language_persistent"
            validate_camera_field(row["style"], row["camera"])
            assert row["timestamp"] in record.frame_timestamps
        EpisodeStaging(tmp_path, record.episode_index).write("plan", persistent)
    report = StagingValidator().validate(records, tmp_path)
    assert (report.errors, report.warnings, report.episodes_checked) == ([], [], len(records))


def test_our_recipe_gives_messages_for_every_frame(dataset: Path) -> None:
    from lerobot.configs.recipe import TrainingRecipe
    from lerobot.datasets.language_render import render_sample

    recipe = TrainingRecipe.from_yaml(RECIPE)
    table = data_table(dataset).select(["index", "timestamp", "language_persistent", "language_events"])
    kinds = set()
    assert table.num_rows > 2000
    for row in table.to_pylist():
        rendered = render_sample(
            recipe=recipe, persistent=row["language_persistent"], events=row["language_events"],
            t=row["timestamp"], sample_idx=row["index"],
        )  # fmt: skip
        assert rendered is not None
        assert all(message["content"].strip() for message in rendered["messages"])
        kinds.add(rendered["message_streams"][-1])
        if len(rendered["messages"]) == 3:
            assert rendered["messages"][1]["content"].startswith("So far: I ")
    assert kinds == {"high_level", "low_level"}


def test_one_subtask_holds_at_every_frame_and_changes_with_the_phase(runs: list[Path], dataset: Path) -> None:
    for run, frames in zip(runs, language_of(dataset), strict=True):
        with _recording(run) as recording:
            phase, misses = recording.phases, recording.trajectory().is_deliberate_miss
            times = (np.arange(len(phase)) / recording.info.fps).astype(np.float32).tolist()
        rows = [active(frames[0][0], "subtask", time) for time in times]
        assert all(len(row) == 1 for row in rows)
        changes = [frame for frame in range(1, len(phase)) if phase[frame] != phase[frame - 1]]
        assert [frame for frame in range(1, len(phase)) if rows[frame] != rows[frame - 1]] == changes
        said = np.array(
            [bool(re.search("to miss it on purpose|missing it on purpose", row[0]["content"])) for row in rows]
        )
        assert np.array_equal(said, misses)
        if misses.any():
            retry = int(np.flatnonzero(misses)[-1]) + 1 + phase[int(np.flatnonzero(misses)[-1]) + 1 :].index("approach")
            assert rows[retry][0]["content"].startswith("try again: ")
            plans = [row["timestamp"] for row in frames[0][0] if row["style"] == "plan"]
            assert plans == [0.0, times[retry]]


def test_subtasks_name_the_lifted_object_and_its_final_place(runs: list[Path], dataset: Path) -> None:
    for run, frames in zip(runs, language_of(dataset), strict=True):
        with _recording(run) as recording:
            trajectory, scene, fps = recording.trajectory(), recording.info.simulated.scene, recording.info.fps
            has_lift = "lift" in recording.phases
        lifts = 0
        subtasks = [row for row in frames[0][0] if row["style"] == "subtask"]
        for row, after in itertools.pairwise(subtasks):
            first, last = (round(part["timestamp"] * fps) for part in (row, after))
            if row["content"].startswith("lift the "):
                risen = {name: poses[last, 2] - poses[first, 2] for name, poses in trajectory.object_poses.items()}
                now = scene_at(scene, {name: poses[first] for name, poses in trajectory.object_poses.items()})
                assert max(risen, key=lambda name: risen[name]) in meant(phrases(row["content"])[0], now)
                lifts += 1
            if row["content"].startswith("lower the ") and "gripper" not in row["content"]:
                _, place = (meant(phrase, scene) for phrase in phrases(row["content"]))
                tcp = scene.robot.world_from_base.apply(trajectory.base_from_tcp[last, :3])
                bodies = {
                    body.name: trajectory.object_poses.get(body.name) for body in scene.bodies if body.name in place
                }
                for name, poses in bodies.items():
                    where = scene.body(name).world_from_body.position if poses is None else poses[last]
                    assert np.abs(tcp[:2] - where[:2]).max() < 0.5 * max(scene.body(name).shape.extents)
        assert lifts >= len(scene.goals) or not has_lift


def test_every_wording_means_the_task_and_nothing_else(runs: list[Path], dataset: Path) -> None:
    for run, frames in zip(runs, language_of(dataset), strict=True):
        with _recording(run) as recording:
            scene, instruction = recording.info.simulated.scene, recording.info.instruction
        wordings = [row["content"] for row in frames[0][0] if row["style"] == "task_aug"]
        assert all(
            row["role"] == "user" and row["timestamp"] == 0 for row in frames[0][0] if row["style"] == "task_aug"
        )
        assert len(wordings) == len(set(wordings)) >= 20
        assert wordings[0] == instruction
        things = {goal.object for goal in scene.goals} | {place_of(scene, goal) for goal in scene.goals}
        for wording in wordings[1:]:
            found = [(phrase, meant(phrase, scene)) for phrase in phrases(wording)]
            assert all(len(names) == 1 or phrase[1] == "every" for phrase, names in found), wording
            named = {name for _, names in found for name in names}
            assert named == things, wording
            assert "{" not in wording
            assert "  " not in wording


def test_motions_are_those_of_the_tcp(runs: list[Path], dataset: Path) -> None:
    axes = {"forward": (0, 1), "backward": (0, -1), "left": (1, 1), "right": (1, -1), "up": (2, 1), "down": (2, -1)}
    for run, frames in zip(runs, language_of(dataset), strict=True):
        with _recording(run) as recording:
            trajectory, fps = recording.trajectory(), recording.info.fps
        rows = [row for row in frames[0][0] if row["style"] == "motion"]
        starts = [round(row["timestamp"] * fps) for row in rows]
        for row, first, last in zip(rows, starts, [*starts[1:], len(frames) - 1], strict=True):
            told = np.zeros(3)
            for centimetres, direction in re.findall(r"(\d+) cm (\w+)", row["content"]):
                axis, sign = axes[direction]
                told[axis] = sign * int(centimetres) / 100
            assert (
                np.abs(told - (trajectory.base_from_tcp[last, :3] - trajectory.base_from_tcp[first, :3])).max()
                <= 0.005001
            )
            opened = trajectory.gripper_width[last] - trajectory.gripper_width[first]
            if match := re.search(r"(open|close) the gripper by ([\d.]+) cm", row["content"]):
                assert abs(float(match[2]) / 100 * (1 if match[1] == "open" else -1) - opened) <= 0.002501
            else:
                assert abs(opened) < 0.0026


def test_memories_follow_completed_actions(runs: list[Path], dataset: Path) -> None:
    for run, frames in zip(runs, language_of(dataset), strict=True):
        with _recording(run) as recording:
            goals, tutorial = recording.info.simulated.scene.goals, recording.info.simulated.task == "tutorial"
        memories = [row for row in frames[0][0] if row["style"] == "memory"]
        subtasks = {row["timestamp"]: row["content"] for row in frames[0][0] if row["style"] == "subtask"}
        assert {row["timestamp"] for row in memories} <= set(subtasks)
        for row in memories:
            if "picked up" in row["content"].split(". ")[-1]:
                assert subtasks[row["timestamp"]].startswith("carry the ")
        if not tutorial:  # it ends with the fall
            assert len(re.findall(r"I put the", memories[-1]["content"])) == len(goals)


def test_the_same_seed_gives_the_same_language_and_changes_nothing_else(runs: list[Path], tmp_path: Path) -> None:
    few = [runs[TASKS.names().index(task)] for task in ("pick_place", "sort_by_color")]
    for name in ("once", "again"):
        export(few, tmp_path / name, language=(), progress=True)
    assert files_of(tmp_path / "again") == files_of(tmp_path / "once")
    export(few, tmp_path / "without")
    without, spoken = data_table(tmp_path / "without"), data_table(tmp_path / "once")
    assert spoken.select(without.column_names).equals(without)
    assert set(spoken.column_names) - set(without.column_names) == {"language_persistent", "language_events"}
    assert dataset_digest(tmp_path / "without") != dataset_digest(tmp_path / "once")


def test_appending_needs_language_where_the_dataset_has_it(runs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "grown"
    export(runs[0], out, language=())
    with pytest.raises(ConfigError, match="language_persistent"):
        export(runs[1], out, append=True)
    report = export(runs[1], out, append=True, language=())
    assert report.digest == dataset_digest(out)
    first, second = language_of(out)
    assert first[0] != second[0]
    assert all(rows == second[0][0] for rows, _ in second)


def test_unknown_kinds_are_refused(runs: list[Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="'poem', its kinds are subtask, plan"):
        export(runs[0], tmp_path / "out", language=("poem",))


@pytest.mark.parametrize("kind", list(THINGS))
def test_objects_have_the_names_of_the_instructions(kind: str) -> None:
    shape = Shape(kind="mesh", size=(0.03, 0.03, 0.03))
    for name in (kind, f"red_{kind}", f"other_red_{kind}", f"red_{kind}_2"):
        body = Body(name=name, role="object", shape=shape, world_from_body=Pose(), mass=0.1)
        assert nouns_of(body)[0] == NOUNS[kind]


def stages_of(run: Path) -> tuple[int, list[StageRun]]:
    """Number of goals and stages of the run's only episode."""
    with _recording(run) as recording:
        num_goals = len(recording.info.simulated.scene.goals)
        return num_goals, dense_runs(episode_timeline(recording))


def test_progress_is_lerobots_own_over_the_true_stages(runs: list[Path], dataset: Path) -> None:
    from lerobot.rewards.sarm.sarm_utils import find_stage_and_tau, normalize_stage_tau

    table = pq.read_table(dataset / "sarm_progress.parquet").to_pydict()
    rows = episode_rows(dataset)
    assert table["index"] == list(range(sum(row["length"] for row in rows)))
    assert table["episode_index"] == data_table(dataset).column("episode_index").to_pylist()
    found = np.array(table["progress_dense"])
    assert 0 <= found.min() <= found.max() <= 1
    episodes = [stages_of(run) for run in runs]
    possible = [dense_stages(num_goals, stage_runs) for num_goals, stage_runs in episodes]
    all_stages = tuple(dict.fromkeys(itertools.chain.from_iterable(possible)))
    share = proportions([stage_runs for _, stage_runs in episodes], all_stages)
    for row, run, (num_goals, stage_runs) in zip(rows, runs, episodes, strict=True):
        names, starts, ends = (list(column) for column in zip(*stage_runs, strict=True))
        assert starts == [0, *(end + 1 for end in ends[:-1])]
        assert ends[-1] == row["length"] - 1
        own = found[row["dataset_from_index"] : row["dataset_to_index"]]
        assert own[0] == 0
        assert own[-1] == 1  # all episodes succeed
        stages = [stage for stage in share if stage in names]
        assert all(f"goal {goal + 1}: " in " ".join(stages) for goal in range(num_goals))
        shares = {stage: share[stage] for stage in stages}
        for frame in range(row["length"]):
            value = find_stage_and_tau(frame, row["length"], names, starts, ends, stages, share, return_combined=True)
            assert isinstance(value, float)
            expected = normalize_stage_tau(value, temporal_proportions=shares, subtask_names=stages)
            assert abs(float(expected) - own[frame]) < 2e-3, (run, frame)
        with _recording(run) as recording:
            misses, phase = recording.trajectory().is_deliberate_miss, recording.phases
        changes = {frame for frame in range(1, len(phase)) if phase[frame] != phase[frame - 1]}
        assert set(starts[1:]) <= changes
        # The object falls only after an attempt that missed.
        falls = np.flatnonzero(np.diff(own) < 0)
        assert falls.tolist() == (np.flatnonzero(misses)[-1:].tolist() if misses.any() else [])


def test_sample_weighting_gives_no_weight_to_a_miss(runs: list[Path], dataset: Path) -> None:
    import torch
    from lerobot.rewards.sarm.rabc import RABCWeights
    from lerobot.utils.sample_weighting import SampleWeightingConfig, make_sample_weighter

    policy = SimpleNamespace(config=SimpleNamespace(chunk_size=10))
    config = SampleWeightingConfig(head_mode="dense")
    weighter = make_sample_weighter(config, policy, torch.device("cpu"), dataset_root=str(dataset))
    assert isinstance(weighter, RABCWeights)
    number = list(TASKS.names()).index(next(iter(MISSING)))
    row, run = episode_rows(dataset)[number], runs[number]
    missed = stages_of(run)[1][2].last  # the last frame of the missed grasp
    frames = torch.arange(row["dataset_from_index"], row["dataset_from_index"] + missed + 20)
    weights, _ = weighter.compute_batch_weights({"index": frames})
    assert (weights[missed - 8 : missed + 1] == 0).all()
    assert (weights[: missed - 10] > 0).all()
    assert (weights[missed + 1 :] > 0).all()


def test_progress_needs_a_whole_dataset(runs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "grown"
    export(runs[0], out, progress=True)
    with pytest.raises(ConfigError, match="--progress is written for a whole dataset"):
        export(runs[1], out, append=True, progress=True)
    with pytest.raises(ConfigError, match="has no progress of new episodes"):
        export(runs[1], out, append=True)
