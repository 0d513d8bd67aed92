"""HDF5 files in the documented layouts of robomimic and ALOHA, written with h5py alone, are imported and compared."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from support.commands import exit_code
from support.export import recordings
from support.hdf5 import (
    ALOHA_CAMERAS,
    HEIGHT,
    ROBOMIMIC_LENGTHS,
    WIDTH,
    images,
    jpeg,
    write_aloha,
    write_isaac,
    write_robomimic,
)

from demorec.extensions.imports.episode_writer import FramesImport
from demorec.extensions.imports.hdf5_import import import_hdf5
from demorec.extensions.imports.hdf5_suggest import suggested_hdf5_mapping
from demorec.mcap import Recording
from demorec.runs.run_file import load_any_run_file

DEMOS = ("demo_0", "demo_1", "demo_10")


def suggested(file: Path, changes: dict[str, str] | None = None) -> Path:
    """The suggested mapping of a file, with some text replaced."""
    text = "\n".join(suggested_hdf5_mapping(file, print))
    for old, new in (changes or {}).items():
        assert old in text
        text = text.replace(old, new)
    path = file.with_suffix(".toml")
    path.write_text(text)
    return path


def imported(*files: Path, changes: dict[str, str] | None = None) -> tuple[FramesImport, Path]:
    """Import files with the suggested mapping of the first."""
    run = files[0].with_name("run")
    return import_hdf5(files, suggested(files[0], changes), run), run


@pytest.fixture(scope="module")
def robomimic(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A robomimic file, and the run imported from it with its suggested mapping."""
    file = write_robomimic(tmp_path_factory.mktemp("robomimic") / "demo.hdf5", compression="gzip")
    return file, imported(file)[1]


def test_numbers_of_robomimic_are_those_of_the_file(robomimic: tuple[Path, Path]) -> None:
    source, run = robomimic
    with h5py.File(source) as file:
        for demo, length, path in zip(DEMOS, ROBOMIMIC_LENGTHS, recordings(run), strict=True):
            obs = {name: file[f"data/{demo}/obs/{name}"][:] for name in file[f"data/{demo}/obs"]}
            expected = {
                "observation.state": np.hstack([obs["robot0_joint_pos"], obs["robot0_gripper_qpos"]]),
                "observation.velocity": np.hstack([obs["robot0_joint_vel"], obs["robot0_gripper_qvel"]]),
                "observation.ee_pose": np.hstack([obs["robot0_eef_pos"], obs["robot0_eef_quat"]]),
                "observation.environment_state": obs["object"],
                "action": file[f"data/{demo}/actions"][:],
            }
            with Recording(path) as recording:
                table, info = recording.table(), recording.info
            assert table.features.keys() == expected.keys()
            for name, values in expected.items():
                assert table.features[name].dtype == np.float64
                np.testing.assert_array_equal(table.features[name], values)
            assert (info.robot_name, info.fps, info.instruction) == ("Panda", 20, "Lift")
            assert table.time_ns.tolist() == [50_000_000 * row for row in range(length)]
            assert {camera.name: (camera.width, camera.height) for camera in info.cameras} == {
                "agentview": (WIDTH, HEIGHT),
                "robot0_eye_in_hand": (WIDTH, HEIGHT),
            }


def nearest(shown: NDArray[np.uint8], candidates: NDArray[np.uint8]) -> int:
    """Return the index of the most similar image."""
    return int(np.abs(candidates.astype(int) - shown).mean(axis=(1, 2, 3)).argmin())


def test_a_dataset_sets_the_outcome(tmp_path: Path) -> None:
    file = write_robomimic(tmp_path / "demo.hdf5")
    changes = {'# success = "rewards"': 'success = "rewards"'}
    with h5py.File(file, "r+") as opened:
        opened["data/demo_10/rewards"][-1] = 0
    result, run = imported(file, changes=changes)
    assert (result.num_episodes, result.num_frames) == (3, 18)
    lines = load_any_run_file(run).attempts
    assert [(line.num_frames, line.success) for line in lines] == [(7, True), (5, True), (6, False)]
    assert set(result.left_out) == {"dones", "states", "next_obs"}


@pytest.mark.parametrize("is_compressed", [False, True])
def test_aloha_becomes_a_run(is_compressed: bool, tmp_path: Path) -> None:
    files = [write_aloha(tmp_path / f"episode_{k}.hdf5", is_compressed=is_compressed, seed=k) for k in range(2)]
    result, run = imported(*files)
    kept = "jpeg passed through as it is" if is_compressed else "pixels, encoded once"
    assert result.cameras == dict.fromkeys(ALOHA_CAMERAS, f"64x48, {kept}")
    for source, path in zip(files, recordings(run), strict=True):
        with h5py.File(source) as file, Recording(path) as recording:
            actions = [file[name][:] for name in ("action", "base_action") if name in file]
            expected = {
                "observation.state": file["observations/qpos"][:],
                "observation.velocity": file["observations/qvel"][:],
                "action": np.hstack(actions),
            }
            table = recording.table()
            for name, values in expected.items():
                assert table.features[name].dtype == np.float32
                np.testing.assert_array_equal(table.features[name], values)
            assert table.time_ns.tolist() == [20_000_000 * row for row in range(8)]
            for k, camera in enumerate(ALOHA_CAMERAS):
                given = images(8, 10 * k)
                if is_compressed:
                    packets = [packet.data for packet in recording.packets(camera)]
                    assert packets == [jpeg(image, 60 + 5 * row) for row, image in enumerate(given)]
                assert [nearest(image, given) for image in recording.images(camera)] == list(range(8))


@pytest.mark.parametrize("is_compressed", [False, True])
def test_swapped_colours_are_corrected(is_compressed: bool, tmp_path: Path) -> None:
    file = write_aloha(tmp_path / "episode_0.hdf5", is_compressed=is_compressed)
    dataset = 'dataset = "observations/images/cam_high"'
    result, run = imported(file, changes={dataset: f'{dataset}\ncolors = "bgr"'})
    assert result.cameras["cam_high"].endswith("with red and blue exchanged, encoded once")
    with Recording(recordings(run)[0]) as recording:
        shown = recording.numbered_image("cam_high", 0)
    red, blue = shown[: HEIGHT // 2, : WIDTH // 2 - 4, 0].mean(), shown[: HEIGHT // 2, : WIDTH // 2 - 4, 2].mean()
    assert blue - red > 200  # the corner is red in the file


@pytest.mark.parametrize("kind", ["uint16", ">f4"])
def test_distances_stay(kind: str, tmp_path: Path) -> None:
    file = write_aloha(tmp_path / "episode_0.hdf5")
    given = np.random.default_rng(3).uniform(0, 5000, (8, HEIGHT, WIDTH)).astype(kind)
    with h5py.File(file, "r+") as opened:
        opened["observations/images/cam_high_depth"] = given
    result, run = imported(file)
    assert result.cameras["cam_high_depth"].endswith("passed through as they are")
    with Recording(recordings(run)[0]) as recording:
        assert recording.depth_cameras == ("cam_high_depth",)
        found = np.array(list(recording.distances("cam_high_depth")))
    assert found.dtype == given.dtype.newbyteorder("=")
    np.testing.assert_array_equal(found, given)


def test_jpeg_of_variable_length_stays_as_it_is(tmp_path: Path) -> None:
    """Rows of h5py's `vlen_dtype`, contiguous and in chunks."""
    file = write_aloha(tmp_path / "episode_0.hdf5")
    given = [jpeg(image, 60 + 4 * row) for row, image in enumerate(images(8, 3))]
    with h5py.File(file, "r+") as opened:
        group = opened["observations/images"]
        for camera, chunks in zip(ALOHA_CAMERAS, (None, (3,)), strict=True):
            del group[camera]
            stored = group.create_dataset(camera, (8,), h5py.vlen_dtype(np.uint8), chunks=chunks)
            for row, data in enumerate(given):
                stored[row] = np.frombuffer(data, np.uint8)
    result, run = imported(file)
    assert result.cameras == dict.fromkeys(ALOHA_CAMERAS, "64x48, jpeg passed through as it is")
    with Recording(recordings(run)[0]) as recording:
        for camera in ALOHA_CAMERAS:
            assert [packet.data for packet in recording.packets(camera)] == given


def test_pixels_with_colours_before_the_height_give_the_same_recording(tmp_path: Path) -> None:
    found = []
    for folder in ("usual", "other"):
        file = write_aloha(tmp_path / folder / "episode_0.hdf5")
        with h5py.File(file, "r+") as opened:
            for camera in ALOHA_CAMERAS if folder == "other" else ():
                images = opened[f"observations/images/{camera}"][:]
                del opened[f"observations/images/{camera}"]
                opened[f"observations/images/{camera}"] = images.transpose(0, 3, 1, 2)
        result, run = imported(file)
        assert all(words.startswith("64x48, pixels") for words in result.cameras.values())
        with Recording(recordings(run)[0]) as recording:
            found.append([[packet.data for packet in recording.packets(camera)] for camera in ALOHA_CAMERAS])
    assert found[0] == found[1]


def _one_observation_more(file: Path) -> None:
    """Add a row to every observation, like recorders that observe both before and after each action."""
    with h5py.File(file, "r+") as opened:
        for name in ("qpos", "qvel", *(f"images/{camera}" for camera in ALOHA_CAMERAS)):
            values = opened[f"observations/{name}"][:]
            del opened[f"observations/{name}"]
            opened[f"observations/{name}"] = np.concatenate([values, values[:1]])


def test_one_observation_more_than_actions_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = []
    for folder in ("usual", "other"):
        file = write_aloha(tmp_path / folder / "episode_0.hdf5")
        if folder == "other":
            _one_observation_more(file)
        run = file.with_name("run")
        assert exit_code("import", "hdf5", file, "--mapping", suggested(file), "--out", run) == 0
        with Recording(recordings(run)[0]) as recording:
            table = recording.table()
            packets = [[packet.data for packet in recording.packets(camera)] for camera in ALOHA_CAMERAS]
            found.append((table.time_ns.tolist(), packets, {n: v.tolist() for n, v in table.features.items()}))
        told = "the last observation of each episode is left out: no action follows it." in capsys.readouterr().out
        assert told == (folder == "other")
    assert found[0] == found[1]


def _soft_link(file: h5py.File) -> None:
    del file["data/demo_1/actions"]
    file["data/demo_1/actions"] = h5py.SoftLink("/data/demo_0/actions")


def _external_link(file: h5py.File) -> None:
    del file["data/demo_1"]
    file["data/demo_1"] = h5py.ExternalLink("/etc/passwd", "/x")


def _replaced(name: str, make: Callable[[h5py.Group, str], object]) -> Callable[[h5py.File], None]:
    def replace(file: h5py.File) -> None:
        group = file["data/demo_1"]
        del group[name]
        make(group, name)

    return replace


FAULTS: dict[str, tuple[Callable[[h5py.File], object], str]] = {
    "no such key": (lambda file: file["data/demo_1/obs"].move("object", "objekt"), "Did you mean 'objekt'"),
    "no episodes": (lambda file: [file.__delitem__(f"data/{name}") for name in DEMOS], "No episodes in data"),
    "other lengths": (
        _replaced("actions", lambda group, name: group.__setitem__(name, np.zeros((3, 7)))),
        "demo_1/obs/agentview_image has 5 rows, other datasets of the episode have 3",
    ),
    "nan": (
        lambda file: file["data/demo_1/obs/object"].__setitem__(3, float("nan")),
        "data/demo_1/obs/object is nan in row 3 (object_0)",
    ),
    "whole numbers": (
        _replaced("actions", lambda group, name: group.__setitem__(name, np.full((5, 7), 2**53 + 1))),
        "whole numbers that float64 cannot hold",
    ),
    "texts": (_replaced("actions", lambda group, name: group.__setitem__(name, ["a"] * 5)), "it holds objects"),
    "unwritten": (
        _replaced("actions", lambda group, name: group.create_dataset(name, (5, 7), "f8")), "not all of its rows"
    ),
    "another width": (
        _replaced("actions", lambda group, name: group.__setitem__(name, np.zeros((5, 8)))), "The episodes differ"
    ),
    "images of integers": (
        _replaced("obs/agentview_image", lambda group, name: group.__setitem__(name, np.zeros((5, 8, 8, 3), np.int32))),
        "images are uint8 of rows",
    ),
    "soft link": (_soft_link, "data/demo_1/actions is a link"),
    "external link": (_external_link, "data/demo_1 is a link"),
    "external storage": (
        _replaced(
            "actions",
            lambda group, name: group.create_dataset(name, (5, 7), "f8", external=[("/etc/passwd", 0, 280)]),
        ),
        "its numbers are in other files",
    ),
    "rate": (
        lambda file: file["data"].attrs.__setitem__("env_args", '{"env_kwargs": {"control_freq": 12.5}}'),
        "12.5 rows a second",
    ),
    "outcome": (
        lambda file: [file[f"data/{name}"].attrs.__setitem__("outcome", "true") for name in DEMOS],
        "has outcome = 'true', allowed are booleans and numbers",
    ),
}  # fmt: skip


CHANGES = {
    "outcome": {'# success = "rewards"': 'success = "outcome"'},
}
"""Fault -> changes of the suggested mapping."""


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_bad_input_is_refused_in_one_sentence(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fault, told = FAULTS[name]
    file = write_robomimic(tmp_path / "demo.hdf5")
    mapping, before = suggested(file, CHANGES.get(name)), file.read_bytes()
    with h5py.File(file, "r+") as opened:
        fault(opened)
    assert file.read_bytes() != before
    _refused(file, mapping, told, capsys)


def _refused(file: Path, mapping: Path, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    run = file.with_name("run")
    capsys.readouterr()
    assert exit_code("import", "hdf5", file, "--mapping", mapping, "--out", run) in (1, 2)
    out, err = capsys.readouterr()
    assert told in err
    assert err.startswith("demorec import: ")
    assert (err.count("\n"), out) == (1, "")
    assert not list(run.rglob("*.mcap*"))


def test_a_truncated_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_robomimic(tmp_path / "demo.hdf5")
    mapping = suggested(file)
    data = file.read_bytes()
    for length, told in ((0, "This is not an HDF5 file"), (9, "HDF5 file cannot"), (len(data) // 2, "it is cut off")):
        file.write_bytes(data[:length])
        _refused(file, mapping, told, capsys)


def test_damaged_compression_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_robomimic(tmp_path / "demo.hdf5", compression="gzip")
    mapping = suggested(file)
    with h5py.File(file) as opened:
        chunk = opened["data/demo_1/obs/agentview_image"].id.get_chunk_info(0)
    data = bytearray(file.read_bytes())
    data[chunk.byte_offset : chunk.byte_offset + 40] = bytes(40)
    file.write_bytes(data)
    assert exit_code("import", "hdf5", file, "--mapping", mapping, "--out", tmp_path / "run") == 1
    assert "data/demo_1/obs/agentview_image cannot be read" in capsys.readouterr().err


JPEG_FAULTS: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "cut off": (lambda row: row[:300].ljust(len(row), b"\0"), "holds no whole JPEG file in row 2"),
    "another size": (lambda row: jpeg(np.zeros((16, 16, 3), np.uint8), 50), "changes its size to 16x16 in row 2"),
}


@pytest.mark.parametrize("name", sorted(JPEG_FAULTS))
def test_jpeg_files_must_be_whole(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, told = JPEG_FAULTS[name]
    file = write_aloha(tmp_path / "episode_0.hdf5", is_compressed=True)
    mapping = suggested(file)
    with h5py.File(file, "r+") as opened:
        stored = opened["observations/images/cam_high"]
        before = stored[2].tobytes()
        after = change(before).ljust(stored.shape[1], b"\0")
        stored[2] = np.frombuffer(after, np.uint8)
        assert after != before
    _refused(file, mapping, told, capsys)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("import", "hdf5", "demo.hdf5"), "An import needs --mapping and --out"),
        (("import", "hdf5", "other.hdf5", "--suggest"), "The layout is not robomimic's or Isaac Lab's"),
        (("import", "hdf5", "demo.hdf5", "demo.hdf5", "--mapping", "demo.toml", "--out", "run"), "given twice"),
        (("import", "hdf5", "demo.hdf5", "--mapping", "bad.toml", "--out", "run"), "Did you mean 'dataset'?"),
    ],
)
def test_wrong_requests_are_refused(
    words: tuple[str, ...], told: str, robomimic: tuple[Path, Path], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    shutil.copy(robomimic[0], tmp_path)
    text = robomimic[0].with_suffix(".toml").read_text()
    (tmp_path / "demo.toml").write_text(text)
    (tmp_path / "bad.toml").write_text(text.replace("dataset = ", "datset = ", 1))
    with h5py.File(tmp_path / "other.hdf5", "w") as file:
        file["numbers"] = [1, 2]
    monkeypatch.chdir(tmp_path)
    assert exit_code(*words) in (1, 2)
    out, err = capsys.readouterr()
    assert told in err
    assert (err.count("\n"), out) == (1, "")


def test_the_state_of_isaac_lab_is_the_absolute_one(tmp_path: Path) -> None:
    """obs/joint_pos is relative to a pose that the file does not contain; the simulator's state is absolute."""
    file = write_isaac(tmp_path / "demo.hdf5", robot="g1.hand")
    result, run = imported(file, changes={"# fps = 20 ": "fps = 50 "})
    assert result.num_episodes == 2
    with h5py.File(file) as source:
        for demo, path in zip(("demo_0", "demo_1"), recordings(run), strict=True):
            absolute = source[f"data/{demo}/states/articulation/g1.hand/joint_position"][:]
            relative = source[f"data/{demo}/obs/joint_pos"][:]
            assert np.abs(absolute - relative).max() > 0.1
            with Recording(path) as recording:
                table, names = recording.table(), {feature.name: feature.names for feature in recording.info.features}
            np.testing.assert_array_equal(table.features["observation.state"], absolute)
            np.testing.assert_array_equal(table.features["observation.joint_pos"], relative)
            pose = np.hstack([source[f"data/{demo}/obs/{name}"][:] for name in ("eef_pos", "eef_quat")])
            np.testing.assert_array_equal(table.features["observation.ee_pose"], pose)
            assert [name[-2:] for name in names["observation.ee_pose"][3:]] == ["qw", "qx", "qy", "qz"]


@pytest.mark.parametrize("layout", ["isaac", "unknown"])
def test_info_needs_no_rate_and_no_mapping(layout: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "demo.hdf5"
    if layout == "isaac":
        write_isaac(path)
    else:
        with h5py.File(path, "w") as file:
            file["log/values"] = np.zeros((3, 2))
    with h5py.File(path) as file:
        first, count, rows = ("data/demo_0", 2, 12) if layout == "isaac" else ("/", None, 0)
        expected: dict[str, list[int]] = {}
        file[first].visititems(
            lambda name, item: expected.update({name: list(item.shape)}) if isinstance(item, h5py.Dataset) else None
        )
    assert exit_code("info", path, "--json") == 0
    plain = json.loads(capsys.readouterr().out)
    assert {row["dataset"]: row["shape"] for row in plain["datasets"]} == expected
    assert (plain["episodes"], plain["rows"], plain["rate"]) == (count, rows, None)
    assert exit_code("info", path) == 0
    assert "unknown: write fps under [clock] in the mapping, and give it to the import by --mapping" in (
        capsys.readouterr().out
    )


@pytest.mark.parametrize("demos", [("demo_0", "demo_2", "demo_10"), ("Trial 4", "ep-3", "x")])
def test_episodes_that_are_groups_at_the_root(demos: tuple[str, ...], tmp_path: Path) -> None:
    names = ("actions", "obs", "contact 2", "force", "tip/pose")
    file, rng = tmp_path / "demo.hdf5", np.random.default_rng(3)
    with h5py.File(file, "w") as made:
        for place in (f"{demo}/{name}" for demo in demos for name in names):
            made[place] = rng.normal(size=(5, 2 if "actions" in place else 4)).astype(np.float32)
    result, run = imported(file, changes={"# fps = 20 ": "fps = 20 "})
    assert result.num_episodes == len(demos)
    with h5py.File(file) as source:
        for demo, path in zip(demos, recordings(run), strict=True):
            with Recording(path) as recording:
                held = {values.tobytes() for values in recording.table().features.values()}
            for name in names:
                assert source[f"{demo}/{name}"][:].tobytes() in held, name
