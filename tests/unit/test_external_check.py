"""Each fault of an external episode is found by its own check; a good episode passes them all."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.check import checked
from support.commands import exit_code
from support.external import FORCE, TOP, Episode, make_external, write_external

from demorec.episode.episode import Sample, SampledFrame
from demorec.extensions.recorder.external_run import episode_path, open_external_run

CAMERAS = (TOP, replace(TOP, name="side"))


def steady(**changes: Any) -> Episode:
    """An episode at its nominal rate, in which nothing is late or missing."""
    episode = make_external(cameras=CAMERAS, **changes)
    frames, top, side = [], [], []
    for index, frame in enumerate(episode.frames):
        time_ns = 10**18 + index * 33_333_333
        samples = {name: Sample(stamp_ns=time_ns, vector=one.vector) for name, one in frame.samples.items()}
        frames.append(SampledFrame(time_ns=time_ns, samples=samples, images={"top": index, "side": index}))
        pixels = episode.images["top"][index][1]
        top.append((time_ns, pixels))
        side.append((time_ns, np.roll(pixels, 7, axis=0)))
    return replace(
        episode, frames=frames, images={"top": top, "side": side}, outcome=replace(episode.outcome, drops={})
    )


def shifted(frame: SampledFrame, *, by: int) -> SampledFrame:
    samples = {name: replace(sample, stamp_ns=sample.stamp_ns + by) for name, sample in frame.samples.items()}
    return replace(frame, time_ns=frame.time_ns + by, samples=samples)


def moved(offset: Callable[[int], int]) -> Callable[[Episode], Episode]:
    """Shift frames and their images to later times."""

    def change(episode: Episode) -> Episode:
        images = {
            name: [(stamp + offset(index), pixels) for index, (stamp, pixels) in enumerate(ones)]
            for name, ones in episode.images.items()
        }
        frames = [shifted(frame, by=offset(index)) for index, frame in enumerate(episode.frames)]
        return replace(episode, frames=frames, images=images)

    return change


def each(change: Callable[[int, SampledFrame], SampledFrame]) -> Callable[[Episode], Episode]:
    return lambda episode: replace(episode, frames=[change(index, frame) for index, frame in enumerate(episode.frames)])


def older(name: str, by: int) -> Callable[[Episode], Episode]:
    def change(index: int, frame: SampledFrame) -> SampledFrame:
        one = frame.samples[name]
        return replace(frame, samples={**frame.samples, name: replace(one, stamp_ns=one.stamp_ns - by)})

    return each(change)


FAULTS: dict[str, tuple[Callable[[Episode], Episode], str]] = {
    "a gap": (moved(lambda i: 6 * 10**7 if i >= 20 else 0), "time_gaps"),
    "half the rate": (moved(lambda i: i * 40_000_000), "frame_rate"),
    "a late sensor": (older("observation.force", 3 * 10**8), "sample_age"),
    "a missing image": (
        each(lambda i, f: replace(f, images={"top": f.images["top"]}) if i == 9 else f), "missing_images"
    ),
    "drops": (lambda e: replace(e, outcome=replace(e.outcome, drops={"frames": 3})), "recording_losses"),
}  # fmt: skip


def verdicts(path: Path) -> dict[str, str]:
    return {result.check: result.verdict for result in checked(path).results}


def test_a_good_episode_passes(tmp_path: Path) -> None:
    found = verdicts(write_external(tmp_path / "a.mcap", steady()))
    assert set(found.values()) <= {"good", "not measured"}
    measured = {"opens", "checksums", "readable", "complete", "recording_losses", "frame_rate", "time_gaps"}
    measured |= {"sample_age", "missing_images", "images_decode", "missing_numbers", "joint_limits", "frozen_state"}
    assert {found[check] for check in measured} == {"good"}


@pytest.mark.parametrize(("force_n", "verdict"), [(0.0, "good"), (5.0, "broken")])
def test_a_contact_sensor_may_stay_at_zero(force_n: float, verdict: str, tmp_path: Path) -> None:
    episode = steady()
    touch = replace(FORCE, name="observation.contact_force", names=("gripper.force",), units=("N",))
    frames = []
    for frame in episode.frames:
        samples = dict(frame.samples)
        force = samples.pop(FORCE.name)
        samples[touch.name] = replace(force, vector=np.array([force_n]))
        frames.append(replace(frame, samples=samples))
    episode = replace(episode, info=replace(episode.info, features=(*episode.info.features[:2], touch)), frames=frames)
    assert verdicts(write_external(tmp_path / "a.mcap", episode))["frozen_sensors"] == verdict


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_by_its_check_alone(tmp_path: Path, fault: str) -> None:
    change, check = FAULTS[fault]
    found = verdicts(write_external(tmp_path / "a.mcap", change(steady())))
    assert {name for name, verdict in found.items() if verdict not in ("good", "not measured")} == {check}


def run(capsys: pytest.CaptureFixture[str], *args: object) -> tuple[int, str]:
    return exit_code(*args), capsys.readouterr().out


@pytest.fixture(scope="module")
def external_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    with open_external_run(folder) as opened:
        for index in range(2):
            opened.add(write_external(episode_path(opened.path, index), steady(num_frames=20, episode_index=index)))
    return folder


def test_a_run_is_recognised_and_checked(external_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, told = run(capsys, "check", external_run)
    assert (code, told.splitlines()[1].startswith("good: 2 episodes")) == (0, True)
    code, told = run(capsys, "info", external_run)
    assert (code, "2 (2 success)" in told, "stack the cups" in told) == (0, True, True)
    code, told = run(capsys, "info", external_run / "episodes" / "episode_000001.mcap", "--json")
    plain = json.loads(told)
    assert (plain["kind"], plain["frames"], plain["robot"]) == ("external recording", 20, "two_joints")
    code, told = run(capsys, "info", external_run / "episodes")
    assert (code, told.count("external, format")) == (0, 2)
