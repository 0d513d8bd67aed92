"""Columns, files and videos of third-party datasets, and their treatment by each command.

tests/property/test_dataset_edits.py verifies that edits keep every value.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import av
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from support.check import edit_parquet
from support.commands import exit_code
from support.drawn_datasets import PLAIN, STATE, TOP, encoded, write_drawn
from support.export import data_table, recordings
from support.foreign_dataset import DATA, EPISODES, TASKS, write_foreign
from support.stored_episodes import task_texts

from demorec.extensions.datasets.episode_places import are_on_grid
from demorec.mcap import Recording
from demorec.view.sources import find_episodes

TEXTS = ("open the drawer", "close the drawer", "valid", "invalid", "push it")
LENGTH, COUNT = 8, 4


def foreign(root: Path, columns: Mapping[str, pa.Array | pa.ChunkedArray], *, dtype: str = "int64") -> Path:
    """A dataset whose episodes have the tasks 4, 0, 1, 0, with extra columns or with replaced ones."""
    write_foreign(root, length=LENGTH, episodes=COUNT)
    table, info = pq.read_table(root / DATA), json.loads((root / "meta/info.json").read_text())
    numbers = [4, 0, 1, 0]
    columns = {"task_index": pa.array(np.repeat(numbers, LENGTH)), **columns}
    for name, values in columns.items():
        if name in table.column_names:
            table = table.drop_columns(name)
        else:
            info["features"][name] = {"dtype": dtype, "shape": [1], "names": None}
        table = table.append_column(name, values)
    pq.write_table(table, root / DATA)
    info["total_tasks"] = len(TEXTS)
    (root / "meta/info.json").write_text(json.dumps(info))
    pq.write_table(pa.table({"task": TEXTS, "task_index": range(len(TEXTS))}), root / TASKS)
    episodes = pq.read_table(root / EPISODES).drop_columns("tasks")
    pq.write_table(episodes.append_column("tasks", pa.array([[TEXTS[n]] for n in numbers])), root / EPISODES)
    return root


def said(root: Path, column: str) -> list[str]:
    """Return the task text behind each row's index."""
    texts = task_texts(root)
    return [texts[number] for number in data_table(root)[column].to_pylist()]


def with_reversed_tasks(root: Path) -> Path:
    """Give the tasks of such a dataset the numbers in the opposite order."""
    pq.write_table(pa.table({"task": TEXTS[::-1], "task_index": range(len(TEXTS))}), root / TASKS)
    episodes = pq.read_table(root / EPISODES).drop_columns("tasks")
    texts = pa.array([[TEXTS[::-1][n]] for n in (4, 0, 1, 0)])
    pq.write_table(episodes.append_column("tasks", texts), root / EPISODES)
    return root


def test_merging_renumbers_references(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = "annotation.task"
    numbers = np.arange(COUNT * LENGTH) % len(TEXTS)
    first = foreign(tmp_path / "a", {name: pa.array(numbers)})
    second = with_reversed_tasks(foreign(tmp_path / "b", {name: pa.array(numbers)}))
    expected = said(first, name) + said(second, name)
    assert exit_code("dataset", "merge", first, second, "--out", tmp_path / "new") == 0, capsys.readouterr().err
    assert said(tmp_path / "new", name) == expected


def test_columns_that_may_be_references_are_refused_where_numbers_change(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = pa.array(np.zeros(COUNT * LENGTH, np.int64))
    first = foreign(tmp_path / "a", {"subtask_id": numbers})
    second = with_reversed_tasks(foreign(tmp_path / "b", {"subtask_id": numbers}))
    assert exit_code("dataset", "merge", first, second, "--out", tmp_path / "new") == 2
    assert "subtask_id may hold task numbers" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("name", "dtype"), [("annotation.human.task", "int64"), ("annotation", "uint8"), ("subtask_id", "int32")]
)
def test_an_import_leaves_references_out_by_name(
    name: str, dtype: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = pa.array((np.arange(COUNT * LENGTH) % len(TEXTS)).astype(dtype))
    source = foreign(tmp_path / "a", {name: numbers, "extra.count": numbers}, dtype=dtype)
    assert exit_code("import", "lerobot", source, "--out", tmp_path / "run") == 0
    assert f"{name} is left out: it may refer to tasks by number, and an export" in capsys.readouterr().out
    with Recording(recordings(tmp_path / "run")[0]) as recording:
        assert [feature.name for feature in recording.info.features] == ["observation.state", "action", "extra.count"]
        assert recording.table().features["extra.count"][:, 0].tolist() == numbers.to_pylist()[:LENGTH]


def measured(jitter_s: float, start_s: float) -> NDArray[np.float32]:
    """Timestamps of four episodes that a clock has measured, or that begin late."""
    random = np.random.default_rng(1)
    steps = np.tile(np.arange(LENGTH) / 10, COUNT) + start_s
    return (steps + random.uniform(0, jitter_s, COUNT * LENGTH)).astype(np.float32)


@pytest.mark.parametrize(("jitter_s", "start_s"), [(0.004, 0.0), (0.02, 1.7)])
def test_measured_timestamps_are_imported_and_shown(
    jitter_s: float, start_s: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seconds = measured(jitter_s, start_s)
    source = foreign(tmp_path / "set", {"timestamp": pa.array(seconds)})
    assert exit_code("import", "lerobot", source, "--out", tmp_path / "run") == 0, capsys.readouterr().err
    for path, stamps in zip(recordings(tmp_path / "run"), seconds.reshape(COUNT, LENGTH), strict=True):
        with Recording(path) as recording:
            assert recording.time_ns.tolist() == np.rint(stamps.astype(np.float64) * 1e9).astype(np.int64).tolist()
    assert exit_code("view", source, "--episodes", "0", "--save", tmp_path / "x.rrd") == 0
    for playback, stamps in zip(find_episodes([source]), seconds.reshape(COUNT, LENGTH).astype(float), strict=True):
        with playback.open() as episode:
            np.testing.assert_allclose(episode.time_ns / 1e9, stamps - stamps[0], atol=1e-8)


def test_a_cut_keeps_the_stages_within_it(tmp_path: Path) -> None:
    source = foreign(tmp_path / "d", {})
    stages = {
        "names": ["reach", "grasp", "lift"], "start_frames": [0, 3, 6], "end_frames": [2, 5, 7],
        "start_times": [0.0, 0.3, 0.6], "end_times": [0.3, 0.6, 0.8],
    }  # fmt: skip
    table = pq.read_table(source / EPISODES)
    for name, values in stages.items():
        table = table.append_column(f"sparse_subtask_{name}", pa.array([values] * COUNT))
    pq.write_table(table, source / EPISODES)
    assert exit_code("dataset", "trim", source, "--head", 4, "--tail", 1, "--out", tmp_path / "new") == 0
    row = pq.read_table(tmp_path / "new" / EPISODES).to_pylist()[1]
    found = [row[f"sparse_subtask_{name}"] for name in stages]
    assert found[:3] == [["grasp", "lift"], [0, 2], [1, 2]]
    np.testing.assert_allclose(found[3:], [[0, 0.2], [0.2, 0.3]], atol=1e-9)


def test_another_image_in_a_row_is_a_difference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_drawn(tmp_path / "a", replace(PLAIN, camera="image", version="v3.0"))
    other = shutil.copytree(source, tmp_path / "b")
    assert exit_code("dataset", "diff", source, other) == 0
    path = next(other.glob("data/*/*.parquet"))
    edit_parquet(path, TOP, lambda images: [*images[:2], images[3], *images[3:]])
    assert exit_code("dataset", "diff", source, other) == 1
    assert f"episode 0: {TOP} differs in 1 of 5 frames, first in frame 2" in capsys.readouterr().out


@pytest.mark.parametrize("begin_s", [0.0, 10.0, 1500.0, 3000.0])
def test_timestamps_of_a_long_episode_are_a_grid(begin_s: float) -> None:
    """float32 rounds times beyond 1,024 s by more than LeRobot's tolerance."""
    seconds = (begin_s + np.arange(300) / 30).astype(np.float32).astype(np.float64)
    assert are_on_grid(seconds, 30, float(seconds[0]))
    seconds[7] += 0.002
    assert not are_on_grid(seconds, 30, float(seconds[0]))


def test_doubles_under_float32_are_named_and_imported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = np.random.default_rng(2).normal(size=(COUNT * LENGTH, 3))
    source = foreign(tmp_path / "set", {"action": pa.array(list(values), pa.list_(pa.float64()))})
    assert exit_code("dataset", "select", source, "--episodes", "0,2", "--out", tmp_path / "new") == 0
    assert "float32 of action, which the data files hold as float64" in capsys.readouterr().out
    assert json.loads((tmp_path / "new/meta/info.json").read_text())["features"]["action"]["dtype"] == "float64"
    assert exit_code("import", "lerobot", source, "--out", tmp_path / "run") == 0
    assert "action is rounded to float32, its type in info.json" in capsys.readouterr().out
    with Recording(recordings(tmp_path / "run")[1]) as recording:
        np.testing.assert_array_equal(
            recording.table().features["action"], values[LENGTH : 2 * LENGTH].astype("float32")
        )


def test_videos_of_other_encoders_are_imported_and_viewed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_drawn(tmp_path / "set", replace(PLAIN, camera="mpeg4"))
    assert exit_code("import", "lerobot", source, "--out", tmp_path / "run") == 0, capsys.readouterr().err
    assert "mpeg4, encoded once" in capsys.readouterr().out
    with av.open(str(min(source.glob("videos/**/*.mp4")))) as container:
        shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    with Recording(recordings(tmp_path / "run")[0]) as recording:
        images = list(recording.images("top"))
    assert len(images) == len(shown)
    assert np.abs(np.stack(images).astype(float) - np.stack(shown)).mean() < 6
    assert exit_code("view", source, "--episodes", "1", "--save", tmp_path / "x.rrd") == 0


def test_a_video_in_fragments_is_refused_with_a_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_drawn(tmp_path / "set", PLAIN)
    path = min(source.glob("videos/**/*.mp4"))
    path.write_bytes(encoded("h264", PLAIN.lengths[0], 3, is_fragmented=True))
    assert exit_code("view", source, "--episodes", "0", "--save", tmp_path / "x.rrd") == 1
    assert "ffmpeg -i FILE -c copy NEW.mp4 joins them" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("dtype", ["absent", "float64"])
def test_counters_that_are_absent_or_doubles_are_read(
    dtype: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    counters = ("timestamp", "frame_index", "index", "task_index")
    source = write_drawn(tmp_path / "set", replace(PLAIN, missing=counters if dtype == "absent" else ()))
    if dtype == "float64":
        for path in source.glob("data/*/*.parquet"):
            table = pq.read_table(path)
            for name in (*counters, "episode_index"):
                place = table.schema.get_field_index(name)
                table = table.set_column(place, name, table[name].cast(pa.float64()))
            pq.write_table(table, path)
    assert exit_code("info", source) == 0
    problems = [line for line in capsys.readouterr().out.splitlines() if "problem" in line]
    if dtype == "absent":
        assert len(problems) == 1
        assert f"The rows have no {', '.join(counters)}, and are taken in their order" in problems[0]
    else:
        assert not problems
    assert exit_code("import", "lerobot", source, "--out", tmp_path / "run") == 0, capsys.readouterr().err
    with Recording(recordings(tmp_path / "run")[1]) as recording:
        assert recording.info.instruction == "close the drawer"
        assert recording.time_ns.tolist() == [100_000_000 * frame for frame in range(6)]
    assert exit_code("dataset", "shuffle", source, "--out", tmp_path / "new") == 0


def test_files_in_folders_that_differ_from_info_json_are_found(tmp_path: Path) -> None:
    source = write_drawn(tmp_path / "set", PLAIN)
    info = json.loads((source / "meta/info.json").read_text())
    info["data_path"] = info["data_path"].replace("{episode_chunk", "{episode_index")
    (source / "meta/info.json").write_text(json.dumps(info))
    (source / "videos").rename(source / "video")
    before = pq.read_table(source / "data/chunk-000/episode_000001.parquet")
    assert exit_code("dataset", "select", source, "--episodes", "1", "--out", tmp_path / "new") == 0
    assert data_table(tmp_path / "new")["action"].to_pylist() == before["action"].to_pylist()
    assert not (tmp_path / "new/video").exists()  # its images are in videos/


def test_a_camera_without_videos_is_named_with_a_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_drawn(tmp_path / "set", PLAIN)
    shutil.rmtree(source / "videos")
    for words in (["import", "lerobot"], ["dataset", "shuffle"]):
        assert exit_code(*words, source, "--out", tmp_path / "new") == 1
        assert "demorec dataset drop-features DATASET observation.images.top --out NEW" in capsys.readouterr().err
    assert exit_code("view", source, "--episodes", "0", "--save", tmp_path / "x.rrd") == 0
    assert "No episode has a video of observation.images.top, which is not shown" in capsys.readouterr().err
    assert exit_code("dataset", "drop-features", source, "observation.images.top", "--out", tmp_path / "rest") == 0
    assert exit_code("import", "lerobot", tmp_path / "rest", "--out", tmp_path / "run") == 0


def test_episodes_without_videos_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_drawn(tmp_path / "set", replace(PLAIN, lengths=(4, 5, 4, 4)))
    for number in (1, 3):
        (source / f"videos/chunk-000/observation.images.top/episode_{number:06d}.mp4").unlink()
    assert exit_code("dataset", "shuffle", source, "--out", tmp_path / "new") == 1
    assert "demorec dataset drop DATASET --episodes 1,3 --out NEW" in capsys.readouterr().err
    assert exit_code("dataset", "drop", source, "--episodes", "1,3", "--out", tmp_path / "new") == 0


def test_actions_of_another_name_are_exported_to_hdf5(tmp_path: Path) -> None:
    source = write_drawn(tmp_path / "set", replace(PLAIN, camera=""))
    assert exit_code("dataset", "rename", source, "action=actions", "--out", tmp_path / "new") == 0
    assert exit_code("import", "lerobot", tmp_path / "new", "--out", tmp_path / "run") == 0
    assert exit_code("export", "hdf5", tmp_path / "run", "--out", tmp_path / "x.hdf5") == 0
    before = pq.read_table(source / "data/chunk-000/episode_000001.parquet")
    with h5py.File(tmp_path / "x.hdf5") as file:
        assert file["data/demo_1/actions"][:].tolist() == before["action"].to_pylist()
        assert list(file["data/demo_1/obs"]) == ["state"]


def test_pointers_of_git_lfs_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_drawn(tmp_path / "set", PLAIN)
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"
    for name in ("meta/episodes.jsonl", "data/chunk-000/episode_000000.parquet"):
        (source / name).write_text(pointer)
        assert exit_code("dataset", "shuffle", source, "--out", tmp_path / "new") == 1
        assert "it is a pointer of Git LFS: fetch the file itself by git lfs pull" in capsys.readouterr().err
        (source / "meta/episodes.jsonl").write_text('{"episode_index": 0, "tasks": ["push it"], "length": 11}\n')


def test_numbers_of_tasks_with_gaps_keep_their_texts(tmp_path: Path) -> None:
    source = write_drawn(tmp_path / "set", PLAIN)
    (source / "meta/tasks.jsonl").write_text(
        '{"task_index": 1, "task": "close it"}\n{"task_index": 0, "task": "open it"}\n'
        '{"task_index": 7, "task": "push it"}\n'
    )
    path = source / "data/chunk-000/episode_000001.parquet"
    table = pq.read_table(path)
    place = table.schema.get_field_index("task_index")
    pq.write_table(table.set_column(place, "task_index", pa.array([7] * 6)), path)
    assert exit_code("dataset", "reorder", source, "--order", "1,0", "--out", tmp_path / "new") == 0
    assert said(tmp_path / "new", "task_index") == ["push it"] * 6 + ["open it"] * 5


def test_omissions_of_an_edit_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_drawn(tmp_path / "set", replace(PLAIN, has_unlisted=True))
    shutil.copy(source / "data/chunk-000/episode_000001.parquet", source / "data/chunk-000/episode_000009.parquet")
    assert exit_code("dataset", "shuffle", source, "--out", tmp_path / "new") == 0
    printed = capsys.readouterr().out
    assert "Left out: is_pad (meta/info.json does not list this column of the data files)" in printed
    assert "data/chunk-000/episode_000009.parquet (no episode of the dataset is in this file)" in printed
    assert "Copied, but not checked: extra/deep/calibration.bin, meta/notes of ours.txt." in printed


def test_a_merge_keeps_the_files_that_are_the_same_in_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sources = [write_drawn(tmp_path / name, PLAIN, seed) for seed, name in enumerate("ab")]
    kept = {"extra/arm.urdf": b"<robot/>", "meta/modality.json": b"{}", "README.md": b"# Cups"}
    for name, content in kept.items():
        for source in sources:
            (source / name).write_bytes(content)
    (sources[1] / "extra/only here.txt").write_text("x")
    for source in sources:
        (source / "meta/episodes").mkdir()
        (source / "meta/episodes/file-000.parquet").write_bytes(b"PAR1")
    for flags in (("--dry-run",), ()):
        assert exit_code("dataset", "merge", *sources, "--out", tmp_path / "new", *flags) == 0
        printed = capsys.readouterr().out
        assert "Copied, but not checked: extra/arm.urdf, meta/modality.json. Check that they still apply." in printed
        different = "extra/deep/calibration.bin, extra/only here.txt, meta/notes of ours.txt"
        assert f"eft out: {different} (not the same in all datasets: copy it if it still applies)" in printed
        assert "meta/episodes/file-000.parquet (LeRobot would read a copy as part of the dataset)" in printed
    assert {name: (tmp_path / "new" / name).read_bytes() for name in kept} == kept
    assert not (tmp_path / "new/meta/notes of ours.txt").exists()


def test_nothing_is_appended_to_a_table_of_episodes_with_other_columns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """LeRobot would read none of the episodes."""
    first, second = (write_drawn(tmp_path / str(seed), replace(PLAIN, version="v3.0"), seed) for seed in range(2))
    assert exit_code("import", "lerobot", second, "--out", tmp_path / "run") == 0
    before = {path: path.read_bytes() for path in first.rglob("*") if path.is_file()}
    words = ["export", "lerobot", tmp_path / "run", "--append", "--no-verify", "--out"]
    assert exit_code(*words, first) == 1
    error = capsys.readouterr().err
    assert f"lacks columns that new episodes have, such as stats/{STATE}/min" in error
    assert f"demorec dataset select {first} --where 'num_frames > 0' --out NEW" in error
    assert {path: path.read_bytes() for path in first.rglob("*") if path.is_file()} == before
    assert exit_code("dataset", "select", first, "--where", "num_frames > 0", "--out", tmp_path / "new") == 0
    assert exit_code(*words, tmp_path / "new") == 0


def test_a_file_with_too_few_images_is_named_for_all_of_its_episodes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As in AgiBot-World#149: images of one episode are missing, and those of all later ones are early."""
    source = write_drawn(tmp_path / "set", replace(PLAIN, version="v3.0", lengths=(5, 6, 4)))
    (path,) = source.rglob("*.mp4")
    assert exit_code("info", source) == 0
    assert "images for" not in capsys.readouterr().out
    path.write_bytes(encoded("h264", 13, 3))
    told = (
        f"{path.relative_to(source).as_posix()} has 13 images for 15 rows of episodes 0 to 2: after the first missing"
    )
    for words, code in (
        (["info", source], 0),
        (["check", source], 1),
        (["view", source, "--episodes", "1", "--save", tmp_path / "x.rrd"], 0),
        (["import", "lerobot", source, "--episodes", "1", "--out", tmp_path / "run"], 0),
        (["dataset", "drop", source, "--episodes", "2", "--out", tmp_path / "new"], 0),
    ):
        assert exit_code(*words) == code, words
        printed = capsys.readouterr()
        assert told in printed.out + printed.err, words
    assert exit_code("dataset", "repair", source, "--out", tmp_path / "repaired") == 1
    assert "13 images for 15 rows" in capsys.readouterr().err


@pytest.mark.parametrize(("listed", "code"), [("valid", 0), ("push it", 1)])
def test_the_table_of_episodes_may_list_the_tasks_of_annotations(listed: str, code: int, tmp_path: Path) -> None:
    validity = pa.array(np.full(LENGTH * COUNT, TEXTS.index("valid")))
    source = foreign(tmp_path / "set", {"annotation.human.validity": validity})
    episodes = pq.read_table(source / EPISODES)
    both = pa.array([sorted({task, listed}) for (task,) in episodes["tasks"].to_pylist()])
    assert exit_code("check", source, "--only", "contradicting_counts") == 0
    pq.write_table(episodes.drop_columns("tasks").append_column("tasks", both), source / EPISODES)
    assert exit_code("check", source, "--only", "contradicting_counts") == code
    assert exit_code("dataset", "select", source, "--episodes", "2", "--out", tmp_path / "new") == 0
    (stored,) = pq.read_table(tmp_path / "new" / EPISODES)["tasks"].to_pylist()
    assert stored == ["close the drawer", "valid"][: 2 - code]


def test_features_missing_from_info_json_are_distinguished_from_missing_columns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_foreign(tmp_path / "set")
    path = source / "meta/info.json"
    info = json.loads(path.read_text())
    for name in ("timestamp", "frame_index"):
        del info["features"][name]
    path.write_text(json.dumps(info))
    pq.write_table(pq.read_table(source / DATA).drop_columns("frame_index"), source / DATA)
    assert exit_code("info", source) == 0
    printed = capsys.readouterr().out
    assert "The rows have no frame_index, and are taken in their order" in printed
    assert "meta/info.json does not list timestamp of the rows" in printed
    assert exit_code("check", source, "--only", "table_schema") == 0  # LeRobot reads everything but frame_index


def test_tasks_as_categories_with_doubles_as_numbers_are_read(tmp_path: Path) -> None:
    numbers = pa.array(np.repeat([4, 0, 1, 0], LENGTH).astype(float))
    source = foreign(tmp_path / "set", {"task_index": numbers})
    table = pa.table({"task": pa.array(TEXTS).dictionary_encode(), "task_index": np.arange(5.0)})
    pq.write_table(table, source / TASKS)
    assert exit_code("check", source, "--only", "table_schema", "contradicting_counts") == 0
    assert exit_code("dataset", "select", source, "--episodes", "0,2", "--out", tmp_path / "new") == 0
    assert said(tmp_path / "new", "task_index") == ["push it"] * LENGTH + ["close the drawer"] * LENGTH
