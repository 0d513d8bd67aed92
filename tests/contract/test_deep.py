"""`check --deep` finds every changed bit of a recording, and names its stream, field and frame."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.check import Spoilt, rewrite_messages, simulate, simulate_run
from support.commands import exit_code
from support.mcap import rewritten

from demorec.cli.generate_report import check_run
from demorec.core.plain import to_plain
from demorec.extensions.recovery.recover import recover
from demorec.extensions.remake.byte_comparison import Contents, content_differences
from demorec.extensions.remake.deep_check import DeepReport, deep_check, deep_checks
from demorec.extensions.remake.options import RerenderOptions
from demorec.extensions.remake.rerender import rerender
from demorec.generate.options import RunResult
from demorec.loop import SimulatorCache
from demorec.mcap import Recording
from demorec.mcap.metadata import EPISODE, OUTCOME
from demorec.runs.run_file import load_run_file

FPS = 10


@pytest.fixture(scope="module")
def simulators() -> Iterator[SimulatorCache]:
    made = SimulatorCache()
    yield made
    made.close()


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with every stream: two cameras, depth, segmentation, joint states at the physics rate, noise."""
    path = tmp_path_factory.mktemp("deep") / "filmed.mcap"
    return simulate(
        path, seed=7, fps=FPS, cameras=("front", "wrist"), width=96, height=96, depth=True, segmentation=True,
        joint_rate="physics", variation="full",
    )  # fmt: skip


@pytest.fixture(scope="module")
def blind(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording without images, which is regenerated quickly."""
    return simulate(tmp_path_factory.mktemp("deep") / "blind.mcap", seed=7, fps=FPS)


def found(report: DeepReport) -> set[tuple[str, str, tuple[int, ...]]]:
    return {(d.stream, d.field, d.frames) for d in report.differences}


def test_good_recordings_are_reproduced(filmed: Path, blind: Path, simulators: SimulatorCache) -> None:
    for path in (filmed, blind):
        report = deep_check(path, simulators)
        assert (report.level, report.differences, report.versions, report.error) == ("pass", (), (), "")
        assert report.num_frames > 40


def test_a_failed_attempt_is_reproduced(tmp_path: Path, simulators: SimulatorCache) -> None:
    path = simulate(tmp_path / "failed.mcap", seed=7, fps=FPS, max_episode_seconds=2.0)
    with Recording(path) as recording:
        assert recording.outcome is not None
        assert recording.outcome.failure_reason == "time_limit"
    assert deep_check(path, simulators).level == "pass"


@pytest.mark.slow
def test_a_rendering_is_reproduced(blind: Path, tmp_path: Path, simulators: SimulatorCache) -> None:
    path = tmp_path / "rendered.mcap"
    rerender(blind, path, RerenderOptions(cameras=("front",), width=64, height=64, looks=3))
    report = deep_check(path, simulators)
    assert (report.level, report.differences) == ("pass", ())


@pytest.mark.slow
def test_one_bit_of_every_topic(filmed: Path, tmp_path: Path, simulators: SimulatorCache) -> None:
    """The last bit of the sixth message of each topic, or of its first if it has fewer: all are named."""
    with Recording(filmed) as recording:
        topics = {topic: count for topic, (_, count) in recording.topics.items()}
    turn = dict.fromkeys(topics, -1)

    def spoil(topic: str, data: bytes) -> bytes:
        turn[topic] += 1
        if turn[topic] != (5 if topics[topic] > 5 else 0):
            return data
        return data[:-1] + bytes([data[-1] ^ 1])

    spoilt = tmp_path / "spoilt.mcap"
    spoilt.write_bytes(rewritten(filmed, messages=spoil))
    report = deep_check(spoilt, simulators)
    assert {d.stream for d in report.differences} == topics.keys()
    assert [d.frames for d in report.differences if d.stream == "/camera/front/depth"] == [(5,)]
    firsts = [d.frames[:1] for d in report.differences]
    assert firsts == sorted(firsts)


def test_one_bit_of_one_number(blind: Path, tmp_path: Path, simulators: SimulatorCache) -> None:
    seen = 0

    def spoil(topic: str, data: bytes) -> bytes:
        nonlocal seen
        seen += topic == "/ee_pose"
        if topic != "/ee_pose" or seen != 6:
            return data
        place = len(data) - 7 * 8  # the last bit of position.x
        return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]

    spoilt = tmp_path / "spoilt.mcap"
    spoilt.write_bytes(rewritten(blind, messages=spoil))
    report = deep_check(spoilt, simulators)
    assert found(report) == {("/ee_pose", "pose.position.x", (5,))}
    assert report.level == "fail"


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (lambda m: () if m[0] == "/ee_pose" and m[3] == 2 * 10**9 else (m,), ("/ee_pose", "messages", (20,))),
        (lambda m: (m, m) if m[0] == "/ee_pose" and m[3] == 2 * 10**9 else (m,), ("/ee_pose", "messages", (20,))),
        (lambda m: () if m[0] == "/tf_static" else (m,), ("/tf_static", "presence", ())),
        (lambda m: (m, ("/mine", *m[1:])) if m[0] == "/wrench" else (m,), ("/mine", "presence", ())),
    ],
    ids=["one less", "one twice", "none", "an unknown topic"],
)
def test_other_messages(edit: Any, expected: object, blind: Path, tmp_path: Path, simulators: SimulatorCache) -> None:
    spoilt = rewrite_messages(blind, tmp_path / "spoilt.mcap", edit)
    assert expected in found(deep_check(spoilt, simulators))


def test_fields_of_the_metadata_are_named(blind: Path, tmp_path: Path) -> None:
    with Recording(blind) as recording:
        info, outcome = to_plain(recording.info), to_plain(recording.outcome)
    info["simulation"]["scene"]["bodies"][1]["mass"] = 7.0
    info["simulation"]["config"]["cameras"] = ["front"]
    info["versions"]["pybullet"] = "0.0.1"  # reported separately
    outcome["num_retries"] += 1
    change = {EPISODE: {"info": json.dumps(info)}, OUTCOME: {"outcome": json.dumps(outcome)}}
    spoilt = tmp_path / "spoilt.mcap"
    spoilt.write_bytes(rewritten(blind, change=change))
    named = {(d.stream, d.field) for d in content_differences(Contents.of(spoilt), Contents.of(blind), FPS)}
    assert named == {
        (f"metadata {EPISODE}", "info.simulation.scene.bodies[1].mass"),
        (f"metadata {EPISODE}", "info.simulation.config.cameras"),
        (f"metadata {EPISODE}", "info.simulation.config.cameras[0]"),
        (f"metadata {OUTCOME}", "outcome.num_retries"),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "line", "also_differs"),
    [
        ({"versions": {"pybullet": "3.2.5"}}, "version of pybullet is 3.2.5 there", True),
        ({"simulation": {"cpu": "riscv64"}}, "it was simulated on riscv64", False),
    ],
)
def test_recordings_of_another_version_or_cpu_are_not_provable_here(
    change: dict[str, Any],
    line: str,
    also_differs: bool,
    blind: Path,
    tmp_path: Path,
    simulators: SimulatorCache,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A difference under another version or CPU is a warning; under the same ones it is a failure."""
    with Recording(blind) as recording:
        info = to_plain(recording.info)
    if also_differs:
        info["instruction"] = "Do something else."
        strict = tmp_path / "strict.mcap"
        strict.write_bytes(rewritten(blind, change={EPISODE: {"info": json.dumps(info)}}))
        assert deep_check(strict, simulators).level == "fail"
    for name, value in change.items():
        info[name] = {**info[name], **value} if isinstance(value, dict) else value
    spoilt = tmp_path / "spoilt.mcap"
    spoilt.write_bytes(rewritten(blind, change={EPISODE: {"info": json.dumps(info)}}))
    report = deep_check(spoilt, simulators)
    assert report.level == "warn"
    assert [d.field for d in report.differences] == (["info.instruction"] if also_differs else [])
    assert exit_code("check", spoilt, "--deep", "--only", "opens") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith(f"warn  made again {spoilt}: ")
    assert f"Not provable here: {line}" in lines[3]
    assert any("info.instruction" in text for text in lines) == also_differs


def test_a_config_that_this_version_cannot_read_is_not_provable_here(
    blind: Path, tmp_path: Path, simulators: SimulatorCache
) -> None:
    with Recording(blind) as recording:
        info = to_plain(recording.info)
    info["simulation"]["config"]["gravity_of_tomorrow"] = 1
    levels = []
    for version in (info["versions"]["demorec"], "99.0.0"):
        info["versions"]["demorec"] = version
        spoilt = tmp_path / f"{version}.mcap"
        spoilt.write_bytes(rewritten(blind, change={EPISODE: {"info": json.dumps(info)}}))
        report = deep_check(spoilt, simulators)
        assert "gravity_of_tomorrow" in report.error
        levels.append(report.level)
    assert levels == ["fail", "warn"]


@pytest.mark.slow
def test_images_that_differ_are_named(filmed: Path, tmp_path: Path, simulators: SimulatorCache) -> None:
    spoilt = Spoilt(filmed)
    depth = spoilt.images[9]["front"].depth
    labels = spoilt.images[12]["wrist"].segmentation
    assert depth is not None
    assert labels is not None
    depth[30, 30] += 0.001
    labels[40, 40] = labels[40, 40] + 1
    report = deep_check(spoilt.write(tmp_path / "spoilt.mcap"), simulators)
    assert report.level == "fail"
    images = {d.stream: d.frames for d in report.differences if d.field == "data"}
    assert images["/camera/front/depth"] == (9,)
    assert images["/camera/wrist/segmentation"] == (12,)
    assert all(d.field == "data" or d.stream.endswith("/histogram") for d in report.differences)


# ---------------------------------------------------------------------------------------------------- the command


@pytest.mark.slow
def test_the_command(blind: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    shutil.copy(blind, folder / "a.mcap")
    rewrite_messages(blind, folder / "b.mcap", lambda m: () if m[0] == "/wrench" and m[3] == 0 else (m,))
    for flags in ((), ("--json",)):
        assert exit_code("check", folder, "--deep", "--only", "opens", *flags) == 1
        told = capsys.readouterr().out
        if flags:
            deep = json.loads(told)["deep"]
            assert [entry["level"] for entry in deep] == ["pass", "fail"]
            streams = [difference["stream"] for difference in deep[1]["results"][0]["differences"]]
            assert "/wrench" in streams
        else:
            assert "the same to the bit" in told
            assert "/wrench messages at frame 0" in told
            assert told.splitlines()[-1].endswith("2 made again, 1 not as recorded.")


def test_a_damaged_file_among_good_ones(blind: Path, tmp_path: Path, simulators: SimulatorCache) -> None:
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(blind.read_bytes()[:-200])
    reports = list(deep_checks([damaged, blind]))
    assert [report.level for report in reports] == ["fail", "pass"]
    assert "cut off" in reports[0].error


@pytest.mark.slow
def test_a_run_makes_a_sample_again(tmp_path: Path) -> None:
    """The check at the end of `generate`: the first and the third of four episodes."""
    folder = simulate_run(tmp_path / "run", 4, seed=7, fps=FPS)
    path = folder / "episodes" / "episode_000002.mcap"
    run = load_run_file(folder)
    result = RunResult(folder=folder, run=run, made=(), seconds=0.0, interrupted=False)
    found, failures = check_run(result, deep_every=2, progress=lambda done, total: None)
    assert "2 episodes generated again" in found
    assert not [failure for failure in failures if "made again" in failure]
    with Recording(path) as recording:
        info = to_plain(recording.info)
    info["instruction"] = "Do something else."
    path.write_bytes(rewritten(path, change={EPISODE: {"info": json.dumps(info)}}))
    found, failures = check_run(result, deep_every=2, progress=lambda done, total: None)
    (failure,) = (failure for failure in failures if "made again" in failure)
    assert failure.startswith(path.name)
    assert "info.instruction" in failure
    info["versions"]["pybullet"] = "0.0.1"  # recorded by another version, so nothing is proved
    path.write_bytes(rewritten(path, change={EPISODE: {"info": json.dumps(info)}}))
    found, failures = check_run(result, deep_every=2, progress=lambda done, total: None)
    assert ", 1 warning (made again)" in found
    assert not [failure for failure in failures if "made again" in failure]
    assert "1 episode generated again" in check_run(result, deep_every=5, progress=lambda done, total: None)[0]
    assert "again" not in check_run(result, deep_every=0, progress=lambda done, total: None)[0]


@pytest.mark.slow
def test_a_truncated_recording_is_compared_up_to_its_end(
    filmed: Path, tmp_path: Path, simulators: SimulatorCache
) -> None:
    part = tmp_path / "cut.mcap.part"
    part.write_bytes(filmed.read_bytes()[: int(0.7 * filmed.stat().st_size)])
    recover(part, tmp_path / "cut.mcap")
    report = deep_check(tmp_path / "cut.mcap", simulators)
    assert (report.level, report.differences) == ("pass", ())
    assert report.num_frames > 5
