"""Images of rows: none is lost that a reader which takes the latest image before each row could show."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections.abc import Callable
from fractions import Fraction
from math import ceil, floor
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from demorec.extensions.imports.fields import reader_of
from demorec.extensions.imports.findings import bag_findings, row_findings
from demorec.extensions.imports.image_messages import ImageHead
from demorec.extensions.imports.mapping import CameraSource, Clock, Robot, Source, SourceMapping, TaskText
from demorec.extensions.imports.rows import EpisodeRows, Timelines, Window
from demorec.extensions.imports.streams import BagStreams, Stream

NS = 1_000_000_000
COUNT = 60
ROUNDINGS: dict[str, Callable[[Fraction], int]] = {
    "down": floor,
    "up": ceil,
    "nearest": lambda time: floor(time + Fraction(1, 2)),
    "microseconds": lambda time: 1000 * round(time / 1000),
    "microseconds down": lambda time: 1000 * floor(time / 1000),
}
PATIENT: dict[str, Any] = {"suppress_health_check": [HealthCheck.too_slow]}
"""Settings for a busy machine."""
SOURCE = Source(topic="/joints", field="position")


def _moments(rate: Fraction, phase: Fraction, jitter: float, seed: int, rounding: str) -> list[int]:
    """A camera's timestamps: exact ticks, each off by at most `jitter` of a period, rounded."""
    off = np.random.default_rng(seed).uniform(-jitter, jitter, COUNT).tolist()
    return [ROUNDINGS[rounding]((100 + phase + k + Fraction(off[k])) * NS / rate) for k in range(COUNT)]


def _stream(part: Source | CameraSource, times: list[int]) -> Stream:
    stream = Stream(label=part.topic[1:], part=part)
    stream.logged, stream.stamped = array("q", [time + 1_000_000 for time in times]), array("q", times)
    if isinstance(part, CameraSource):
        stream.heads = [ImageHead("jpeg", "", 64, 48, True)] * len(times)
        stream.places = array("q", range(len(times)))
    else:
        stream.dtype = np.dtype(np.float64)
        stream.reader = reader_of(part, {"name": ["a"], "position": np.zeros(1)})
        stream.vectors = bytearray(np.linspace(0, 1, len(times)).tobytes())
    return stream


def _rows(cameras: dict[str, list[int]], clock: Clock) -> tuple[Timelines, EpisodeRows]:
    """Rows of a bag with these cameras, and with joints at 1 kHz from before the first image until after the last."""
    first, last = min(min(times) for times in cameras.values()), max(max(times) for times in cameras.values())
    joints = list(range(first - 2_000_000, last + 2 * NS // clock.fps, 1_000_000))
    mapping = SourceMapping(
        robot=Robot(name="r"), task=TaskText(text="t"), clock=clock,
        features={"observation.state": (SOURCE,), "action": (SOURCE,)},
        cameras={name: CameraSource(topic=f"/{name}") for name in cameras},
    )  # fmt: skip
    streams = BagStreams(mapping)
    streams.all = {(name, 0): _stream(SOURCE, joints) for name in mapping.features}
    streams.all |= {name: _stream(mapping.cameras[name], times) for name, times in cameras.items()}
    lines = Timelines(streams, mapping)
    return lines, lines.rows(Window(begin_ns=joints[0], end_ns=joints[-1]))


def _numbers(rows: EpisodeRows, camera: str) -> NDArray[np.int64]:
    """(R,) index of the image of each row."""
    return rows.cameras[camera].taken[rows.table.images[camera]]


def _kinds(lines: Timelines, rows: EpisodeRows) -> set[str]:
    return {finding.kind for finding in (*bag_findings(lines), *row_findings(lines, [rows]))}


rates = st.one_of(st.integers(5, 200).map(Fraction), st.floats(5, 200).map(Fraction))
jitters = st.one_of(st.just(0.0), st.floats(0.0, 1 / 3))
phases = st.fractions(0, 1, max_denominator=1000)
seeds = st.integers(0, 2**32 - 1)
roundings = st.sampled_from(sorted(ROUNDINGS))


@pytest.mark.slow
@settings(max_examples=40, **PATIENT)
@given(rates, phases, jitters, seeds, roundings)
def test_a_camera_of_any_rate(rate: Fraction, phase: Fraction, jitter: float, seed: int, rounding: str) -> None:
    """Any rate works; the suggested fps is the rounded rate."""
    times = _moments(rate, phase, jitter, seed, rounding)
    lines, rows = _rows({"front": times}, Clock(fps=round(rate), max_age_s=1.0))
    assert _numbers(rows, "front").tolist() == list(range(COUNT))
    assert rows.table.time_ns.tolist() == times
    if jitter < 0.1 and abs(rate / round(rate) - 1) < 0.03:
        assert _kinds(lines, rows) == set()


@pytest.mark.slow
@settings(max_examples=40, **PATIENT)
@given(st.integers(5, 200), phases, jitters, seeds, roundings)
def test_an_even_grid(rate: int, phase: Fraction, jitter: float, seed: int, rounding: str) -> None:
    times = _moments(Fraction(rate), phase, jitter, seed, rounding)
    lines, rows = _rows({"front": times}, Clock(fps=rate, rows="grid", max_age_s=1.0))
    steps = np.diff(rows.table.time_ns)
    assert set(steps.tolist()) <= {NS // rate, -(-NS // rate)}
    expected = [bisect_right(times, time) - 1 for time in rows.table.time_ns.tolist()]
    numbers = _numbers(rows, "front").tolist()
    assert numbers == expected
    assert set(numbers) == set(range(COUNT))
    assert "repeats" not in _kinds(lines, rows)
    # Little later than necessary: without jitter images are new, except for a row after the last one.
    if not jitter:
        assert sorted(rows.table.image_age_ns("front").tolist())[COUNT - 2] <= 2 * NS / rate / 64 + 3_000


@pytest.mark.slow
@settings(max_examples=40, **PATIENT)
@given(st.integers(5, 200), phases, phases, st.floats(0.0, 0.15), seeds, roundings)
def test_two_cameras(rate: int, phase: Fraction, other: Fraction, jitter: float, seed: int, rounding: str) -> None:
    """With jitter of up to 0.15 of a period all images are used: those of a pair are closer together than
    consecutive ones.
    """
    cameras = {
        "front": _moments(Fraction(rate), phase, jitter, seed, rounding),
        "side": _moments(Fraction(rate), other, jitter, seed + 1, rounding),
    }
    lines, rows = _rows(cameras, Clock(fps=rate, max_age_s=1.0))
    for name, times in cameras.items():
        numbers = _numbers(rows, name)
        assert numbers.tolist() == [bisect_right(times, time) - 1 for time in rows.table.time_ns.tolist()]
        # All between the first and the last image are kept; lost are only images from before the other camera began.
        assert set(numbers.tolist()) == set(range(numbers[0], numbers[-1] + 1))
        assert numbers[0] <= 1
        assert numbers[-1] >= COUNT - 2
    assert "repeats" not in _kinds(lines, rows)
