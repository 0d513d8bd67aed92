"""The recorder in a user's loop: it records its inputs in real time, however the loop ends."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.external import URDF

from demorec import Recorder
from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, RecordingError
from demorec.episode.episode import NO_IMAGE
from demorec.episode.info import Camera, Feature
from demorec.extensions.recorder.encoder import BackgroundEncoder
from demorec.mcap import Recording
from demorec.robots.panda import PANDA
from demorec.runs.run_file import load_any_run_file

TOP = {"top": (48, 64)}
PIXELS = np.zeros((48, 64, 3), dtype=np.uint8)


def recorder(folder: Path, **changes: Any) -> Recorder:
    clock: Iterator[int] = iter(range(1_000_000_000, 10**12, 33_000_000))
    given: dict[str, Any] = {"robot": "so101", "fps": 30, "task": "stack", "clock": lambda: next(clock)}
    return Recorder(folder, **{**given, "when_full": "wait", **changes})


def recording_of(folder: Path, index: int = 0) -> Recording:
    return Recording(folder / "episodes" / f"episode_{index:06d}.mcap")


def test_inputs_are_recorded_bit_exactly(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    states = random.normal(size=(40, 6)).astype(np.float32)
    actions, forces = random.normal(size=(40, 2)), random.normal(size=(40, 3))
    buffer = PIXELS.copy()
    with recorder(tmp_path / "run", cameras=TOP) as run, run.episode() as episode:
        for index in range(40):
            buffer[:] = 5 * index  # the program may reuse its memory at once
            episode.write({"state": states[index], "force": forces[index]}, actions[index], {"top": buffer})
        episode.success = True
    with recording_of(tmp_path / "run") as found:
        table = found.table()
        assert table.features["observation.state"].tobytes() == states.tobytes()
        assert table.features["observation.force"].tobytes() == forces.tobytes()
        assert table.features["action"].tobytes() == actions.tobytes()
        assert table.time_ns.tolist() == [1_000_000_000 + 33_000_000 * index for index in range(40)]
        assert (found.info.robot_name, found.info.instruction, found.info.fps) == ("so101", "stack", 30)
        assert found.outcome is not None
        assert (found.outcome.success, found.outcome.num_frames, found.outcome.drops) == (True, 40, {})
        for index, image in enumerate(found.images("top")):
            assert abs(int(image.mean()) - 5 * index) < 4


def test_stamps_of_the_caller_and_missing_or_repeated_images(tmp_path: Path) -> None:
    with recorder(tmp_path / "run", cameras=TOP) as run, run.episode() as episode:
        episode.write([0.0], [0.0], {"top": None}, time_ns=100, stamps={"observation.state": 90})
        episode.write([1.0], [0.0], {"top": (PIXELS, 150)}, time_ns=200)
        episode.write([2.0], [0.0], {"top": (PIXELS, 150)}, time_ns=300)  # the camera has nothing newer
        episode.write([3.0], [0.0], {"top": (PIXELS, 350)}, time_ns=400)
    with recording_of(tmp_path / "run") as found:
        table = found.table()
        assert table.time_ns.tolist() == [100, 200, 300, 400]
        assert table.stamps["observation.state"].tolist() == [90, 200, 300, 400]
        assert table.images["top"].tolist() == [NO_IMAGE, 0, 0, 1]
        assert table.image_stamps["top"].tolist() == [150, 350]
        assert found.outcome is not None
        assert found.outcome.success is None


def feature_of(folder: Path, name: str) -> Feature:
    with recording_of(folder) as found:
        return next(feature for feature in found.info.features if feature.name == name)


@pytest.mark.parametrize(
    ("robot", "observation", "names", "joints"),
    [
        ("arm", [1.0, 2.0], ("0", "1"), ()),
        (["a", "b"], [1.0, 2.0], ("a", "b"), ("a", "b")),
        (["a", "b"], [1.0, 2.0, 3.0], ("a", "b", "gripper"), ("a", "b", "")),
        (["a", "b"], [1, 2, 3, 4], ("0", "1", "2", "3"), ()),
        ("arm", {"x": 1, "y": np.float32(2)}, ("x", "y"), ()),
        (URDF, {"shoulder.pos": 1.0, "elbow.pos": 2.0, "jaw": 3.0}, ("shoulder.pos", "elbow.pos", "jaw"),
         ("shoulder", "elbow", "")),
        (URDF, [1.0, 2.0], ("shoulder", "elbow"), ("shoulder", "elbow")),
        (PANDA, [0.0] * 9, PANDA.joint_names, PANDA.joint_names),
    ],
)  # fmt: skip
def test_elements_get_the_best_known_names(
    tmp_path: Path, robot: Any, observation: Any, names: tuple[str, ...], joints: tuple[str, ...]
) -> None:
    with recorder(tmp_path / "run", robot=robot) as run, run.episode() as episode:
        episode.write(observation)
    state = feature_of(tmp_path / "run", "observation.state")
    assert (state.names, state.joints, state.dtype) == (names, joints, "float64")
    with recording_of(tmp_path / "run") as found:
        assert found.info.urdf == (URDF if robot == URDF else found.info.urdf if robot is PANDA else "")
        values = list(observation.values()) if isinstance(observation, dict) else observation
        assert found.table().features["observation.state"][0].tolist() == values


def test_the_run_continues_where_it_ended(tmp_path: Path) -> None:
    for _ in range(2):
        with recorder(tmp_path / "run") as run:
            for task in ("", "another"):
                with run.episode(task) as episode:
                    episode.write([0.0])
            with run.episode():
                pass  # nothing was recorded, so there is no episode
            with run.episode() as episode:
                episode.write([0.0])
                episode.discard()
    found = load_any_run_file(tmp_path / "run")
    assert [line.episode_index for line in found.attempts] == [0, 1, 2, 3]
    assert [line.instruction for line in found.attempts] == ["stack", "another"] * 2
    assert sorted(path.name for path in (tmp_path / "run" / "episodes").iterdir()) == [
        f"episode_00000{n}.mcap" for n in range(4)
    ]


def test_a_lost_run_json_is_made_again(tmp_path: Path) -> None:
    with recorder(tmp_path / "run") as run, run.episode() as episode:
        episode.write([0.0])
    before = load_any_run_file(tmp_path / "run")
    for damage in (None, "{"):
        (tmp_path / "run" / "run.json").unlink()
        if damage is not None:
            (tmp_path / "run" / "run.json").write_text(damage)
        with recorder(tmp_path / "run"):
            pass
        assert load_any_run_file(tmp_path / "run").attempts == before.attempts
    assert (tmp_path / "run" / "run.json.damaged").read_text() == "{"


def test_the_end_of_an_episode_is_reported(tmp_path: Path) -> None:
    with recorder(tmp_path / "run") as run:
        with pytest.raises(ZeroDivisionError), run.episode() as episode:  # noqa: PT012
            episode.write([0.0])
            episode.success = True
            raise ZeroDivisionError("the gripper is stuck")
        with pytest.raises(KeyboardInterrupt), run.episode() as episode:  # noqa: PT012
            episode.write([0.0])
            episode.success = True
            raise KeyboardInterrupt
    failed, interrupted = load_any_run_file(tmp_path / "run").attempts
    assert failed.success is False
    assert interrupted.success is True
    assert interrupted.reason == "interrupted"
    with recording_of(tmp_path / "run") as found:
        assert found.outcome is not None
        assert (found.outcome.success, found.outcome.num_frames) == (False, 1)


Act = Callable[[Any], object]
BAD: dict[str, tuple[Act, str]] = {
    "length": (lambda e: e.write([0.0]), r"of shape \(1,\), it must be float64 of shape \(2,\)"),
    "feature": (lambda e: e.write({"stat": [0.0, 1.0]}), "unknown feature 'observation.stat'.*'observation.state'"),
    "mixture": (lambda e: e.write({"a": 0.0, "force": [1.0]}), r"'observation.a' is float64 of shape \(\)"),
    "element": (lambda e: e.write({"a": 0.0, "c": 1.0}), "no element 'c'"),
    "missing element": (lambda e: e.write({"a": 0.0}), "lacks the element 'b'"),
    "action": (lambda e: e.write([0.0, 1.0], [0.0]), "unknown feature 'action'"),
    "camera": (lambda e: e.write([0.0, 1.0], images={"tip": PIXELS}), "Unknown camera 'tip'"),
    "tuple": (lambda e: e.write([0.0, 1.0], images={"top": (PIXELS,)}), "must be .pixels, stamp in ns"),
    "still": (lambda e: e.write([0.0, 1.0], time_ns=1_000_000_000), "stamps must not repeat"),
    "stamp": (lambda e: e.write([0.0, 1.0], stamps={"acton": 5}), "unknown feature 'acton'"),
    "nan": (lambda e: e.write([0.0, np.nan]), "is nan in its element 'b'"),
    "float time": (lambda e: e.write([0.0, 1.0], time_ns=1.5), "must be a whole number of nanoseconds"),
    "feature goes back": (lambda e: e.write([0.0, 1.0], stamps={"observation.state": 5}), "the stamp 5 ns"),
    "size": (lambda e: e.write([0.0, 1.0], images={"top": PIXELS[:-1]}), r"uint8 of shape \(47, 64, 3\), it must be"),
    "image goes back": (lambda e: e.write([0.0, 1.0], images={"top": (PIXELS, 5)}), "has the stamp 5 ns, the one"),
    "after the end": (lambda e: (e.finish(), e.write([0.0, 1.0])), "The episode has ended"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_one_sentence_and_costs_one_frame(tmp_path: Path, what: str) -> None:
    act, words = BAD[what]
    with recorder(tmp_path / "run", robot=["a", "b"], cameras=TOP) as run:
        episode = run.episode()
        episode.write([0.0, 1.0], images={"top": (PIXELS, 900_000_000)})
        with pytest.raises(RecordingError, match=words) as error:
            act(episode)
        assert "\n" not in str(error.value)
        if what != "after the end":
            episode.write([2.0, 3.0], images={"top": PIXELS})
        episode.finish()
    with recording_of(tmp_path / "run") as found:
        expected = [[0.0, 1.0]] if what == "after the end" else [[0.0, 1.0], [2.0, 3.0]]
        assert found.table().features["observation.state"].tolist() == expected


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fps": 0}, "fps is 0"),
        ({"robot": ""}, "name is empty"),
        ({"robot": "<robot"}, "not valid XML"),
        ({"robot": "nothing.urdf"}, "No such file"),
        ({"cameras": {"top": 480}}, "give \\(height, width\\)"),
        ({"cameras": {"top": Camera(name="tip", width=1, height=1)}}, "described as 'tip'"),
        ({"cameras": {"top": (47, 64)}}, "64x47 pixels cannot be h264 video, which needs even sizes.* the codec jpeg"),
        ({"cameras": {"top": (48, 65)}, "video": VideoConfig(codec="av1")}, "65x48 pixels cannot be av1 video"),
        ({"when_full": "panic"}, "choose from error, drop, wait"),
        ({"task": None}, "The task is None; describe"),
    ],
)
def test_invalid_settings_are_refused_before_a_folder_is_made(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        recorder(tmp_path / "run", **changes)
    assert not (tmp_path / "run").exists()


def test_odd_sizes_are_recorded_by_the_recommended_codec(tmp_path: Path) -> None:
    cameras, pixels = {"top": (47, 65)}, np.full((47, 65, 3), 90, dtype=np.uint8)
    with recorder(tmp_path / "run", cameras=cameras, video=VideoConfig(codec="jpeg")) as run, run.episode() as episode:
        episode.write([0.0], [0.0], images={"top": pixels})
    with recording_of(tmp_path / "run") as found:
        (image,) = found.images("top")
        assert np.abs(image.astype(int) - pixels).max() <= 3


def test_foreign_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_text("")
    (tmp_path / "file").write_text("")
    (tmp_path / "generated").mkdir()
    (tmp_path / "generated" / "run.json").write_text('{"format": 1, "config": {}}')
    for name, words in (("photos", "cat.jpg"), ("file", "is a file"), ("generated", "run of another kind")):
        with pytest.raises(ConfigError, match=words):
            recorder(tmp_path / name)
    with recorder(tmp_path / "run") as run, run.episode() as episode:
        episode.write([0.0])
        with pytest.raises(ConfigError, match="Another run is writing here"):
            recorder(tmp_path / "run")
        with pytest.raises(RecordingError, match="An episode is already being recorded"):
            run.episode()
    with recorder(tmp_path / "run", robot="ur5", fps=20) as run:
        episode = run.episode()
        with pytest.raises(ConfigError, match="robot is so101 there and ur5 here; fps is 30 there and 20 "):
            episode.write([0.0, 1.0])
    with recorder(tmp_path / "run", task="") as run, pytest.raises(ConfigError, match="no task text"):
        run.episode()


def held_up(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """The encoder waits for this event."""
    go_on, write = threading.Event(), BackgroundEncoder._write

    def waits(self: BackgroundEncoder, *waiting: Any) -> None:
        if not go_on.wait(30):
            go_on.set()  # so that a failing test does not wait again for every frame
        write(self, *waiting)

    monkeypatch.setattr(BackgroundEncoder, "_write", waits)
    return go_on


def test_frames_that_the_encoder_cannot_take_are_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = held_up(monkeypatch)
    with recorder(tmp_path / "run", when_full="error") as run, run.episode() as episode:
        with pytest.raises(RecordingError, match=r"cannot keep up .15 frames are waiting.: choose faster encoding"):  # noqa: PT012
            for _ in range(40):
                episode.write([0.0])
        go_on.set()
    assert 15 <= load_any_run_file(tmp_path / "run").attempts[0].num_frames <= 16


def test_frames_that_the_encoder_cannot_take_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = held_up(monkeypatch)
    with recorder(tmp_path / "run", when_full="drop") as run, run.episode() as episode:
        taken = [episode.write([float(index)]) for index in range(50)]
        go_on.set()
    line = load_any_run_file(tmp_path / "run").attempts[0]
    assert line.num_frames == sum(taken)
    assert line.drops == {"frames": 50 - sum(taken)}
    with recording_of(tmp_path / "run") as found:
        values = found.table().features["observation.state"][:, 0].tolist()
    assert values == [index for index, there in enumerate(taken) if there]


KILLED = """
import sys, time
import numpy as np
from demorec import Recorder
with Recorder(sys.argv[1], robot="arm", cameras={"top": (48, 64)}, fps=50, task="wait") as recorder:
    with recorder.episode() as episode:
        for index in range(10**6):
            episode.write([float(index)], [0.0], {"top": np.full((48, 64, 3), index % 200, dtype=np.uint8)})
            print(index, flush=True)
            time.sleep(0.02)
"""


@pytest.mark.slow
def test_a_killed_program_loses_at_most_a_second(tmp_path: Path) -> None:
    command = [sys.executable, "-c", KILLED, str(tmp_path / "run")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as program:
        assert program.stdout is not None
        last = 0
        for line in program.stdout:
            last = int(line)
            if last == 120:
                program.kill()
                break
        last = max([last, *(int(line) for line in program.stdout)])
    with recorder(tmp_path / "run", robot="arm", cameras=TOP, fps=50) as run:
        assert len(run.recovered) == 1
        with run.episode() as episode:
            episode.write([0.0], [0.0])
    first, second = load_any_run_file(tmp_path / "run").attempts
    assert (first.success, second.episode_index) == (None, 1)
    assert last - 50 <= first.num_frames - 1 <= last
    with recording_of(tmp_path / "run") as found:
        table = found.table()
        assert table.features["observation.state"][:, 0].tolist() == list(range(first.num_frames))
        assert table.images["top"].tolist() == list(range(first.num_frames))
        assert found.is_recovered
