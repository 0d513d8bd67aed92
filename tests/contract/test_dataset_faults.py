"""Faults of datasets that their files alone give away, faults that the sidecar does, and datasets of other runs."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.check import checked, edit_column, edit_json, level_of, simulate, simulate_run
from support.export import rewrite_video
from support.mcap import rewritten

from demorec.cli import main
from demorec.core.errors import ExportError
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.mcap import Recording, channels

CAMERA = "observation.images.front"
Fault = Callable[[Path], None]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three filmed episodes and their dataset."""
    folder = simulate_run(
        tmp_path_factory.mktemp("faults") / "run", 3, seed=3, fps=10, cameras=("front",), width=64, height=64
    )
    export_lerobot([folder], folder / "dataset", ExportOptions(verify=False))
    return folder


@pytest.fixture
def dataset(run: Path, tmp_path: Path) -> Path:
    shutil.copytree(run / "dataset", tmp_path / "dataset")
    return tmp_path / "dataset"


def of_info(change: Callable[[Any], Any]) -> Fault:
    return lambda dataset: edit_json(dataset / "meta/info.json", change)


def of_feature(name: str, **values: Any) -> Fault:
    return of_info(lambda data: data["features"][name].update(values))


def of_video(**values: Any) -> Fault:
    return of_info(lambda data: data["features"][CAMERA]["info"].update({f"video.{k}": v for k, v in values.items()}))


def of_tasks(column: str, value: Callable[[int], Any]) -> Fault:
    def fault(dataset: Path) -> None:
        path = dataset / "meta/tasks.parquet"
        table = pq.read_table(path)
        pq.write_table(replaced(table, column, [value(number) for number in range(table.num_rows)]), path)

    return fault


def of_stats(name: str, quantity: str, value: Callable[[Any], Any]) -> Fault:
    return lambda dataset: edit_json(
        dataset / "meta/stats.json", lambda data: data[name].update({quantity: value(data[name][quantity])})
    )


def of_table(place: str, change: Callable[[pa.Table], pa.Table]) -> Fault:
    def spoil(dataset: Path) -> None:
        path = next(dataset.glob(f"{place}/*/*.parquet"))
        table = pq.read_table(path)
        changed = change(table)
        assert not changed.equals(table)
        pq.write_table(changed, path)

    return spoil


def replaced(table: pa.Table, name: str, values: list[Any]) -> pa.Table:
    place = table.schema.get_field_index(name)
    return table.set_column(place, table.schema.field(name), pa.array(values, table.schema.field(name).type))


def value_of(name: str, row: int, value: Any, place: str = "data") -> Fault:
    """One value of one row becomes another."""

    def change(table: pa.Table) -> pa.Table:
        values = table.column(name).to_pylist()
        if isinstance(values[row], list) and not isinstance(value, list):
            values[row][1] = value
        else:
            values[row] = value
        return replaced(table, name, values)

    return of_table(place, change)


def retyped(name: str, kind: pa.DataType) -> Fault:
    def change(table: pa.Table) -> pa.Table:
        place = table.schema.get_field_index(name)
        return table.set_column(place, name, table.column(name).cast(kind))

    return of_table("data", change)


def first_half(value: list[Any]) -> list[Any]:
    return [0.5 * number for number in value]


ALONE: dict[str, tuple[Fault, str]] = {
    "a column that is no feature": (of_info(lambda data: data["features"].pop("next.reward")), "dataset_schema"),
    "a feature that is no column": (of_table("data", lambda t: t.drop_columns(["next.reward"])), "dataset_readable"),
    "an extra column": (of_table("data", lambda t: t.append_column("x", t.column("index"))), "dataset_schema"),
    "another type in the table": (retyped("next.reward", pa.float64()), "dataset_schema"),
    "another type in info.json": (of_feature("next.reward", dtype="float64"), "dataset_schema"),
    "names too few": (of_info(lambda d: d["features"]["action"]["names"].pop()), "dataset_schema"),
    "a name twice": (
        of_info(lambda d: d["features"]["action"]["names"].__setitem__(1, d["features"]["action"]["names"][0])),
        "dataset_schema",
    ),
    "a shape of other length": (of_feature("action", shape=[7]), "dataset_readable"),
    "a counter of another type": (of_feature("index", dtype="float32"), "dataset_schema"),
    "another robot": (of_info(lambda data: data.update(robot_type="iiwa")), "dataset_schema"),
    "a joint that the robot has not": (
        of_info(lambda d: d["features"]["observation.state"]["names"].__setitem__(2, "elbow")), "dataset_schema"
    ),
    "another codec": (of_video(codec="av1"), "dataset_schema"),
    "another height": (of_video(height=128), "dataset_schema"),
    "another width": (of_video(width=32), "dataset_schema"),
    "another rate of the video": (of_video(fps=30), "dataset_schema"),
    "other channels": (of_video(channels=1), "dataset_schema"),
    "another pixel format": (of_video(pix_fmt="yuv444p"), "dataset_schema"),
    "another shape of the images": (of_feature(CAMERA, shape=[32, 32, 3]), "dataset_schema"),
    "another fps": (of_info(lambda data: data.update(fps=20)), "dataset_schema"),
    "fps 0": (of_info(lambda data: data.update(fps=0)), "dataset_readable"),
    "a split too short": (of_info(lambda data: data.update(splits={"train": "0:2"})), "dataset_schema"),
    "a split too long": (of_info(lambda data: data.update(splits={"train": "0:9"})), "dataset_schema"),
    "splits that overlap": (
        of_info(lambda data: data.update(splits={"train": "0:2", "test": "1:3"})), "dataset_schema"
    ),
    "splits of no form": (of_info(lambda data: data.update(splits=["0:3"])), "dataset_schema"),
    "a wrong quantile": (of_stats("action", "q10", first_half), "dataset_statistics"),
    "quantiles exchanged": (of_stats("observation.state", "q99", lambda v: v[::-1]), "dataset_statistics"),
    "a wrong minimum": (of_stats("observation.velocity", "min", first_half), "dataset_statistics"),
    "a wrong count": (of_stats("action", "count", lambda v: [v[0] - 1]), "dataset_statistics"),
    "a quantile that is missing": (of_stats("action", "q50", lambda v: []), "dataset_statistics"),
    "an episode's mean": (
        value_of("stats/action/mean", 1, 0.7, "meta/episodes"), "dataset_episode_statistics"
    ),
    "an episode's quantile": (
        value_of("stats/observation.state/q90", 2, -0.7, "meta/episodes"), "dataset_episode_statistics"
    ),
    "an episode's count": (value_of("stats/action/count", 0, [3], "meta/episodes"), "dataset_episode_statistics"),
    "an episode's colours": (
        value_of(f"stats/{CAMERA}/mean", 1, [[[0.1]], [[0.9]], [[0.1]]], "meta/episodes"),
        "dataset_image_statistics",
    ),
    "a NaN in the state": (value_of("observation.state", 20, float("nan")), "dataset_readable"),
    "an infinity in the action": (value_of("action", 20, float("inf")), "dataset_readable"),
    "a null in the reward": (value_of("next.reward", 20, None), "dataset_readable"),
    "a null in an index": (value_of("task_index", 20, None), "dataset_readable"),
    "an unknown task": (value_of("task_index", 20, 7), "dataset_counts"),
    "a task below 0": (value_of("task_index", 20, -1), "dataset_counts"),
    "no timestamps": (of_info(lambda data: data["features"].pop("timestamp")), "dataset_readable"),
    "an episode without frames": (value_of("length", 1, 0, "meta/episodes"), "dataset_readable"),
    "an episode that ends late": (value_of("length", 2, 10_000, "meta/episodes"), "dataset_readable"),
    "a row's range that ends late": (value_of("dataset_to_index", 1, 10_000, "meta/episodes"), "dataset_counts"),
    "a video's range that ends early": (
        value_of(f"videos/{CAMERA}/to_timestamp", 1, 1.0, "meta/episodes"), "dataset_counts"
    ),
    "rows of no episode": (of_table("data", lambda t: pa.concat_tables([t, t.slice(0, 5)])), "dataset_counts"),
    "an episode that is done early": (value_of("next.done", 10, True), "dataset_counts"),
    "episodes that are never done": (
        lambda dataset: edit_column(dataset, "next.done", np.zeros_like), "dataset_counts"
    ),
    "a reward without a success": (value_of("next.reward", 10, 1.0), "dataset_counts"),
    "a depth map of three channels": (
        of_info(lambda d: d["features"][CAMERA]["info"].update(is_depth_map=True)), "dataset_schema"
    ),
    "a deviation of images of 255": (
        of_stats(CAMERA, "std", lambda v: [[[255 * row[0][0]]] for row in v]), "dataset_image_statistics"
    ),
    "quantiles of images out of order": (of_stats(CAMERA, "q10", lambda v: [[[0.99]]] * 3), "dataset_image_statistics"),
    "image statistics without a maximum": (
        lambda dataset: edit_json(dataset / "meta/stats.json", lambda data: data[CAMERA].pop("max")),
        "dataset_image_statistics",
    ),
    "quaternions of another length": (
        lambda dataset: edit_column(dataset, "observation.ee_pose", lambda rows: rows * [1, 1, 1, 1.1, 1.1, 1.1, 1.1]),
        "unit_quaternions",
    ),
    "tasks numbered from 1": (of_tasks("task_index", lambda number: number + 1), "dataset_counts"),
    "names of dimensions in another order": (
        of_feature(CAMERA, names=["channels", "height", "width"]), "dataset_schema"
    ),
    "sound that is not there": (
        of_info(lambda data: data["features"][CAMERA]["info"].update(has_audio=True)), "dataset_schema"
    ),
    "statistics that are gone": (lambda dataset: (dataset / "meta/stats.json").unlink(), "dataset_statistics"),
}  # fmt: skip
"""Name -> what is done to the files of a dataset without sidecar, and the check that fails."""


@pytest.mark.parametrize("name", ALONE)
def test_the_files_alone_give_it_away(name: str, dataset: Path) -> None:
    fault, check = ALONE[name]
    shutil.rmtree(dataset / "demorec")
    fault(dataset)
    assert level_of(dataset, check, "dataset") == "fail"


def at(frame: int, change: Callable[[Any], Any]) -> Callable[[list[Any]], list[Any]]:
    return lambda images: [change(p) if number == frame else p for number, p in enumerate(images)]


def second_video(dataset: Path) -> None:
    path = next(dataset.glob("videos/*/*/*.mp4"))
    shutil.copy(path, path.with_name("file-001.mp4"))


WARNED: dict[str, tuple[Fault, str]] = {
    "a file of images that no episode has": (second_video, "dataset_strays"),
    "a table of episodes said to be elsewhere": (
        value_of("meta/episodes/file_index", 1, 3, "meta/episodes"),
        "dataset_strays",
    ),
    "placeholders for instructions": (of_tasks("task", lambda number: f"task_{number}"), "dataset_instructions"),
    "statistics of what is no feature": (
        lambda dataset: edit_json(dataset / "meta/stats.json", lambda data: data.update(force=data["action"])),
        "dataset_statistics",
    ),
}


@pytest.mark.parametrize("name", WARNED)
def test_what_is_warned_of(name: str, dataset: Path) -> None:
    fault, check = WARNED[name]
    assert level_of(dataset, check, "dataset") == "pass"
    fault(dataset)
    assert level_of(dataset, check, "dataset") == "warn"


FACTS: dict[str, Fault] = {
    "another duration": value_of("duration_s", 1, 99.0, "meta/episodes"),
    "another mass": value_of("drawn/object_mass", 1, 99.0, "meta/episodes"),
    "another measure of a condition": value_of("success_checks/tilt", 1, 0.3, "meta/episodes"),
    "another start": value_of("object_x", 1, 0.1, "meta/episodes"),
    "an attempt that is said to be left out": value_of("in_dataset", 1, False, "demorec/attempts"),
    "an attempt of another start": value_of("object_x", 1, 0.1, "demorec/attempts"),
}
"""Name -> what is done to columns by which episodes are chosen, and to the attempts."""


@pytest.mark.parametrize("name", FACTS)
def test_a_fact_that_the_sidecar_contradicts(name: str, dataset: Path) -> None:
    assert level_of(dataset, "dataset_facts", "dataset") == "pass"
    FACTS[name](dataset)
    assert level_of(dataset, "dataset_facts", "dataset") == "fail"


IMAGES: dict[str, Callable[[list[Any]], list[Any]]] = {
    "a black image": at(30, np.zeros_like),
    "a green image": at(31, lambda p: np.zeros_like(p) + np.array([0, 135, 0], dtype=np.uint8)),
    "noise": at(32, lambda p: np.random.default_rng(0).integers(0, 255, p.shape, dtype=np.uint8)),
    "upside down": at(33, lambda p: p[::-1]),
    "an image too few": lambda images: images[:-1],
}


@pytest.mark.parametrize("name", IMAGES)
def test_a_single_image(name: str, dataset: Path) -> None:
    shutil.rmtree(dataset / "demorec")
    rewrite_video(dataset, CAMERA, IMAGES[name])
    assert level_of(dataset, "stray_images", "dataset") == "fail"


def test_images_coded_anew_are_no_fault(dataset: Path) -> None:
    rewrite_video(dataset, CAMERA, lambda images: [*images[:-1], images[-2]])
    assert level_of(dataset, "stray_images", "dataset") == "pass"
    assert level_of(dataset, "dataset_image_statistics", "dataset") == "pass"


def of_pose(camera: str, change: Callable[[Any], Any]) -> Fault:
    def spoil(table: pa.Table) -> pa.Table:
        poses = np.array(table.column(camera).to_pylist())
        return replaced(table, camera, change(poses).tolist())

    return of_table("demorec/camera_poses", spoil)


def nested(column: str, change: Callable[[Any], Any]) -> Fault:
    """A change of what the sidecar has of the second episode."""

    def spoil(table: pa.Table) -> pa.Table:
        values = table.column(column).to_pylist()
        change(values[1])
        return replaced(table, column, values)

    return of_table("demorec/episodes", spoil)


def farther(row: Any) -> None:
    row["mount_from_camera"][0] += 0.05


DETAILS: dict[str, Fault] = {
    "a camera's path late by a frame": of_pose("wrist", lambda poses: np.roll(poses, 1, axis=0)),
    "a camera's path in another place": of_pose("wrist", lambda poses: poses + 0.01),
    "a camera elsewhere": nested("cameras", lambda rows: farther(rows[0])),
    "another focal length": nested("cameras", lambda rows: rows[0]["intrinsics"].__setitem__(0, 100.0)),
    "a goal of another object": nested("goals", lambda rows: rows[0].update(object="table")),
    "an object that starts elsewhere": nested(
        "objects", lambda rows: rows[0]["world_from_object_start"].__setitem__(0, 0.9)
    ),
    "a phase that is missing": nested("phases", lambda rows: rows.pop(1)),
    "a condition that failed": nested("checks", lambda rows: rows[0].update(passed=False)),
    "another seed": value_of("root_seed", 1, 77, "demorec/episodes"),
    "another attempt": value_of("attempt", 1, 3, "demorec/episodes"),
    "another task": value_of("task", 1, "stack", "demorec/episodes"),
    "a config of another run": lambda dataset: edit_json(
        dataset / "demorec/configs.json", lambda data: next(iter(data.values())).update(seed=77)
    ),
}
"""Name -> what is done to the sidecar of a dataset with a camera on the hand."""


@pytest.fixture(scope="module")
def with_wrist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wrist")
    simulate_run(folder / "run", 2, seed=3, fps=10, cameras=("wrist",), width=64, height=64)
    export_lerobot([folder / "run"], folder / "dataset", ExportOptions(verify=False))
    return folder / "dataset"


def test_details_of_a_good_one(with_wrist: Path) -> None:
    assert level_of(with_wrist, "dataset_details", "dataset") == "pass"


@pytest.mark.parametrize("name", DETAILS)
def test_a_detail_of_the_sidecar(name: str, with_wrist: Path, tmp_path: Path) -> None:
    dataset = Path(shutil.copytree(with_wrist, tmp_path / "dataset"))
    DETAILS[name](dataset)
    assert level_of(dataset, "dataset_details", "dataset") == "fail"


def swap_names(data: Any) -> None:
    names = data["features"]["observation.state"]["names"]
    names[0], names[1] = names[1], names[0]


DESCRIBED: dict[str, Fault] = {
    "names in another order": of_info(swap_names),
    "an unknown robot": of_info(lambda data: data.update(robot_type="so100")),
    "names of nobody": of_info(lambda d: d["features"]["action"].update(names=[f"a{n}" for n in range(8)])),
    "twice the rate": of_info(lambda data: data.update(fps=20)),
    "larger images": of_feature(CAMERA, shape=[128, 128, 3]),
}


@pytest.mark.parametrize("name", DESCRIBED)
def test_the_sidecar_contradicts_it(name: str, dataset: Path) -> None:
    DESCRIBED[name](dataset)
    assert level_of(dataset, "dataset_description", "dataset") == "fail"


def test_the_good_ones_pass(run: Path) -> None:
    report = checked(run / "dataset", "dataset", images=False)
    assert [r for r in report.results if r.level in ("warn", "fail")] == []
    for check in ("stray_images", "dataset_image_statistics"):
        assert level_of(run / "dataset", check, "dataset") == "pass"
    assert level_of(run, "run_dataset_content", "run") == "pass"
    shutil.copytree(run / "dataset", run.parent / "bare")
    shutil.rmtree(run.parent / "bare" / "demorec")
    report = checked(run.parent / "bare", "dataset", images=False)
    assert [r for r in report.results if r.level in ("warn", "fail")] == []


def test_a_dataset_of_another_run(run: Path, tmp_path: Path) -> None:
    other = simulate_run(tmp_path / "other", 3, seed=4, fps=10, task="stack")
    shutil.copytree(run / "dataset", other / "dataset")
    assert level_of(other, "run_dataset_content", "run") == "fail"


def test_an_episode_that_was_edited_with_its_digest(run: Path, tmp_path: Path) -> None:
    """As an exporter with a fault would leave it: only the recording knows better."""
    from demorec.datasets.lerobot.inspect import episode_digests
    from demorec.datasets.lerobot.layout import DatasetInfo

    spoilt = tmp_path / "run"
    shutil.copytree(run, spoilt)
    dataset = spoilt / "dataset"
    edit_column(dataset, "observation.velocity", lambda rows: rows * (1 + 1e-5))
    digests = episode_digests(dataset, DatasetInfo.load(dataset))
    of_table("demorec/episodes", lambda table: replaced(table, "content_digest", digests))(dataset)
    assert level_of(dataset, "dataset_sidecar", "dataset") == "pass"
    assert level_of(spoilt, "run_dataset_content", "run") == "fail"


@pytest.mark.slow
def test_deep_makes_the_episodes_of_a_dataset_again(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def told(*flags: str) -> tuple[object, list[str]]:
        with pytest.raises(SystemExit) as ended:
            main(["check", str(dataset), "--deep", "--only", "dataset_readable", *flags])
        return ended.value.code, capsys.readouterr().out.splitlines()

    code, lines = told()
    assert code in (0, None)
    assert len([line for line in lines if "the same to the bit" in line]) == 3
    value_of("observation.velocity", 20, 0.123)(dataset)
    value_of("failure_reason", 1, "bad luck", "demorec/episodes")(dataset)
    code, lines = told()
    assert code == 1
    assert [line.split()[0] for line in lines if "made again" in line][:3] == ["fail", "fail", "pass"]
    assert any("observation.velocity at frame 20" in line for line in lines)
    assert any("sidecar's failure_reason" in line for line in lines)


def test_a_recording_with_nan_is_not_exported(tmp_path: Path) -> None:
    source, seen = simulate(tmp_path / "a.mcap", fps=10), 0

    def spoil(topic: str, data: bytes) -> bytes:
        nonlocal seen
        seen += topic == channels.GRIPPER
        if topic != channels.GRIPPER or seen != 12:
            return data
        return data[:-40] + np.float64(np.nan).tobytes() + data[-32:]  # position, then two sequences of one number

    (tmp_path / "b.mcap").write_bytes(rewritten(source, messages=spoil))
    with Recording(tmp_path / "b.mcap") as recording:
        assert np.flatnonzero(np.isnan(recording.columns().gripper_width)).tolist() == [11]
    with pytest.raises(ExportError, match=r"observation.state is not finite in frame 11"):
        export_lerobot([tmp_path / "b.mcap"], tmp_path / "ds", ExportOptions(verify=False))
    assert not (tmp_path / "ds").exists()


def test_episodes_are_told_of_by_their_numbers(run: Path, tmp_path: Path) -> None:
    """Where the sidecar lacks one, as after LeRobot's resume, the others are not taken for their neighbours."""
    from demorec.check.dataset import Dataset
    from demorec.check.run_dataset import with_videos

    spoilt = tmp_path / "run"
    shutil.copytree(run, spoilt)
    (path,) = (spoilt / "dataset" / "demorec" / "episodes").glob("*/*.parquet")
    pq.write_table(pq.read_table(path).slice(1), path)
    for episode, _ in with_videos(Dataset(spoilt / "dataset")):
        assert episode.number == int(episode.rows["episode_index"][0, 0])
    assert level_of(spoilt, "run_dataset_content", "run") == "pass"
    for name in ("dataset_description", "dataset_facts"):
        assert level_of(spoilt / "dataset", name, "dataset") == "pass"
