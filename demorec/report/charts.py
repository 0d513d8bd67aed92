"""Geometry of the page's charts, which templates/charts.html draws as SVG."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.episode.info import EpisodeInfo
from demorec.report.content import ReportedEpisode
from demorec.report.histogram import Histogram

WIDTH, HEIGHT = 220, 70
"""Of a chart without its labels, in units of its SVG."""
MAP_SIDE, MAP_MARGIN = 420, 44
_COVERAGE_BINS = 14


class Chart(NamedTuple):
    """A small chart: areas and lines over a range of values.

    Attributes:
        title: The quantity and its unit.
        paths: (CSS class, SVG path).
        low, high, middle: Labels below its left end, its right end and its middle.
        note: Below the title.
    """

    title: str
    paths: list[tuple[str, str]]
    low: str
    high: str
    middle: str = ""
    note: str = ""


def distribution(title: str, series: Sequence[tuple[str, Histogram]]) -> Chart:
    """Densities of one or two components over their common range; of each its CSS class and its values."""
    note = "mean: " + ", ".join(f"{name} {histogram.mean:.3g}" for name, histogram in series)
    low = min(histogram.minimum for _, histogram in series)
    high = max(histogram.maximum for _, histogram in series)
    if low == high:  # a single value, whose bin would be too narrow to be seen
        bar = f"M{WIDTH / 2 - 2:g} 0h4v{HEIGHT}h-4z"
        return Chart(title, [(series[0][0], bar)], "", "", f"{low:.3g}", note)
    outlines = [(name, _outline(histogram)) for name, histogram in series]
    top = max(density for _, points in outlines for _, density in points)
    paths = []
    for name, points in outlines:
        steps = [(WIDTH * min(max((x - low) / (high - low), 0.0), 1.0), HEIGHT * (1 - y / top)) for x, y in points]
        paths.append((name, "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in steps)))
    return Chart(title, paths, f"{low:.3g}", f"{high:.3g}", "", note)


def _outline(histogram: Histogram) -> list[tuple[float, float]]:
    """Corners of the bins' outline: (value, density), beginning and ending at density 0."""
    points = []
    for number in range(min(histogram.bins), max(histogram.bins) + 1):
        density = histogram.bins.get(number, 0) / histogram.count / histogram.width
        points += [(number * histogram.width, density), ((number + 1) * histogram.width, density)]
    return [(points[0][0], 0.0), *points, (points[-1][0], 0.0)]


def coverage(title: str, values: Array, failed: NDArray[np.bool_]) -> Chart:
    """Number of episodes in each part of a range of values (N,): successes below, failures (N,) on top of them."""
    counts, edges = np.histogram(values, bins=_COVERAGE_BINS)
    bad, _ = np.histogram(values[failed], bins=edges)
    highest, width = max(int(counts.max()), 1), WIDTH / _COVERAGE_BINS
    bars: dict[str, str] = {"succeeded": "", "failed": ""}
    for number, (total, wrong) in enumerate(zip(counts.tolist(), bad.tolist(), strict=True)):
        for name, base, height in (("succeeded", 0, total - wrong), ("failed", total - wrong, wrong)):
            if height:
                bottom, up = HEIGHT * (1 - base / highest), HEIGHT * height / highest
                bars[name] += f"M{number * width:.1f} {bottom:.1f}v{-up:.1f}h{width - 1:.1f}v{up:.1f}z"
    paths = [(name, path) for name, path in bars.items() if path]
    return Chart(title, paths, f"{edges[0]:.3g}", f"{edges[-1]:.3g}", f"up to {highest}")


def floor_map(members: Sequence[tuple[int, ReportedEpisode, EpisodeInfo]]) -> dict[str, object] | None:
    """The table from above, the robot below: x points up, y to the left; None without goals.

    Args:
        members: (number, episode, its info).

    Returns:
        "rows" and "columns" of the grid: (position, label); "goals": (x, y) in the map; "starts" of the objects:
        (x, y, color, number and name of the episode, whether it failed), failures last.
    """
    objects = [
        (info.scene.body(goal.object), info.scene.world_from_goal(goal).position, goal.object, number, episode)
        for number, episode, info in sorted(members, key=lambda member: member[1].success is False)
        for goal in info.scene.goals
    ]
    if not objects:
        return None
    starts = np.array([body.world_from_body.position[:2] for body, *_ in objects])
    goals = np.array([position[:2] for _, position, *_ in objects])
    low, high = np.minimum(starts, goals).min(axis=0), np.maximum(starts, goals).max(axis=0)
    side, middle = max(float((high - low).max()), 1e-6) * 1.1, (low + high) / 2

    def drawn(points: Array) -> list[list[float]]:
        """(N, 2) places in metres -> right and down in the map."""
        found = MAP_SIDE / 2 - (points - middle)[:, ::-1] / side * MAP_SIDE + (MAP_MARGIN, 0)
        return [[round(value, 1) for value in point] for point in found.tolist()]

    def grid(axis: int) -> list[tuple[float, str]]:
        values = _ticks(middle[axis] - side / 2, middle[axis] + side / 2)
        points = drawn(np.array([values, values]).T)
        return [(point[1 - axis], f"{value:g}") for value, point in zip(values, points, strict=True)]

    return {
        "rows": grid(0),
        "columns": grid(1),
        "goals": drawn(goals),
        "starts": [
            (*point, css_color(body.rgba), number, f"{episode.name}: {name}", episode.success is False)
            for point, (body, _, name, number, episode) in zip(drawn(starts), objects, strict=True)
        ],
    }


def css_color(rgb: Sequence[float]) -> str:
    """Of red, green and blue from 0 to 1."""
    return "#" + "".join(f"{round(255 * min(max(channel, 0.0), 1.0)):02x}" for channel in rgb[:3])


def phase_bar(episode: ReportedEpisode, moments: int, colors: Mapping[str, str]) -> list[tuple[str, str, str, str]]:
    """(title, left, width, color) of each phase, in units of one image of the filmstrip above.

    The middle of each image stands over its own moment.
    """
    last = max(episode.num_frames - 1, 1)
    bars = []
    for name, first, end in episode.phases:
        left, right = (0.5 + (moments - 1) * min(frame, last) / last for frame in (first, end))
        title = f"{name}, frames {first} to {end - 1}"
        bars.append((title, f"{left:.6g}", f"{right - left:.6g}", colors[name]))
    return bars


def _ticks(low: float, high: float) -> list[float]:
    """Three to eight round numbers in a range."""
    rough = (high - low) / 8
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough)
    return [round(number * step, 9) for number in range(math.ceil(low / step), math.floor(high / step) + 1)]
