"""Numbers drawn as SVG, in the colours of the page's style; phases have those of the viewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.check.coverage import ticks
from demorec.geometry import Array
from demorec.playback.style import PHASES
from demorec.report.content import PhaseSpan
from demorec.report.histogram import Histogram
from demorec.report.markup import Markup, joined, tag

_WIDTH, _HEIGHT, _BELOW = 220, 70, 18
_COVERAGE_BINS = 14
_SIDE, _EDGE = 420, 44


def distribution(series: Sequence[tuple[str, Histogram]], title: str) -> Markup:
    """Densities of one or two components over their common range, the first one filled, the second one a line.

    Args:
        series: (class of the curve, values).
        title: For who cannot see it.
    """
    low = min(histogram.minimum for _, histogram in series)
    high = max(histogram.maximum for _, histogram in series)
    if low == high:  # one value, and bins too narrow to be seen
        return _chart(_bar(_WIDTH / 2 - 2, 0, 4, _HEIGHT, series[0][0]), "", "", title, _number(low))
    outlines = [(name, _outline(histogram)) for name, histogram in series]
    most = max(density for _, points in outlines for _, density in points)
    paths = []
    for name, points in outlines:
        steps = [(_WIDTH * min(max((x - low) / (high - low), 0.0), 1.0), _HEIGHT * (1 - y / most)) for x, y in points]
        paths.append(tag("path", d="M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in steps), class_=name))
    return _chart(joined(paths), _number(low), _number(high), title)


def _outline(histogram: Histogram) -> list[tuple[float, float]]:
    """Corners of the bins' outline: (value, share of all values in a unit), beginning and ending at 0."""
    points = []
    first, last = min(histogram.bins), max(histogram.bins)
    for number in range(first, last + 1):
        density = histogram.bins.get(number, 0) / histogram.count / histogram.width
        points += [(number * histogram.width, density), ((number + 1) * histogram.width, density)]
    return [(points[0][0], 0.0), *points, (points[-1][0], 0.0)]


def coverage(values: Array, failed: NDArray[np.bool_], title: str) -> Markup:
    """How many episodes lie in each part of a range: successes below, failures (N,) on top of them."""
    counts, edges = np.histogram(values, bins=_COVERAGE_BINS)
    bad, _ = np.histogram(values[failed], bins=edges)
    most, width = max(int(counts.max()), 1), _WIDTH / _COVERAGE_BINS
    bars = []
    for number, (count, wrong) in enumerate(zip(counts.tolist(), bad.tolist(), strict=True)):
        top, middle = _HEIGHT * (1 - count / most), _HEIGHT * (1 - (count - wrong) / most)
        left = round(number * width, 1)
        if count > wrong:
            bars.append(_bar(left, middle, width - 1, _HEIGHT - middle, "succeeded"))
        if wrong:
            bars.append(_bar(left, top, width - 1, middle - top, "failed"))
    return _chart(joined(bars), _number(edges[0]), _number(edges[-1]), title, f"up to {most}")


def _bar(x: float, y: float, width: float, height: float, name: str) -> Markup:
    return tag("rect", x=x, y=round(y, 1), width=round(width, 1), height=round(height, 1), class_=name)


def _chart(content: Markup, low: str, high: str, title: str, middle: str = "") -> Markup:
    return tag(
        "svg",
        tag("title", title),
        tag("path", d=f"M0 {_HEIGHT}H{_WIDTH}", class_="axis"),
        content,
        tag("text", low, x=0, y=_HEIGHT + 14),
        tag("text", high, x=_WIDTH, y=_HEIGHT + 14, text_anchor="end"),
        tag("text", middle, x=_WIDTH / 2, y=_HEIGHT + 14, text_anchor="middle") if middle else None,
        viewBox=f"0 0 {_WIDTH} {_HEIGHT + _BELOW}",
        role="img",
    )


def _number(value: float) -> str:
    return f"{value:.3g}"


@dataclass(frozen=True, kw_only=True)
class Place:
    """A point of the map, metres in the world frame: where an object starts or shall be, and of which episode."""

    x: float
    y: float
    rgba: tuple[float, ...]
    href: str
    name: str
    failed: bool


def floor_map(starts: Sequence[Place], goals: Sequence[Place]) -> Markup:
    """From above, the robot below, as `demorec check --coverage-picture` draws it: x upwards, y to the left."""
    points = np.array([(place.x, place.y) for place in (*starts, *goals)])
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(float((high - low).max()), 1e-6) * 1.1
    middle_x, middle_y = float(low[0] + high[0]) / 2, float(low[1] + high[1]) / 2

    def right(y: float) -> float:
        return round(_EDGE + _SIDE / 2 - (y - middle_y) / side * _SIDE, 1)

    def down(x: float) -> float:
        return round(_SIDE / 2 - (x - middle_x) / side * _SIDE, 1)

    parts = [tag("rect", x=_EDGE, y=0, width=_SIDE, height=_SIDE, class_="frame")]
    for tick in ticks(middle_x - side / 2, middle_x + side / 2):
        parts.append(tag("path", d=f"M{_EDGE} {down(tick)}h{_SIDE}", class_="grid"))
        parts.append(tag("text", f"{tick:g}", x=_EDGE - 6, y=down(tick) + 4, text_anchor="end"))
    for tick in ticks(middle_y - side / 2, middle_y + side / 2):
        parts.append(tag("path", d=f"M{right(tick)} 0v{_SIDE}", class_="grid"))
        parts.append(tag("text", f"{tick:g}", x=right(tick), y=_SIDE + 16, text_anchor="middle"))
    parts.append(tag("text", "x (m)", x=_EDGE + 6, y=16))
    parts.append(tag("text", "y (m)", x=_EDGE + _SIDE - 6, y=_SIDE - 8, text_anchor="end"))
    for goal in goals:
        parts.append(tag("circle", cx=right(goal.y), cy=down(goal.x), r=4, class_="goal"))
    for start in sorted(starts, key=lambda place: place.failed):  # failures on top
        x, y = right(start.y), down(start.x)
        fill = "#" + "".join(f"{round(255 * min(max(channel, 0.0), 1.0)):02x}" for channel in start.rgba[:3])
        mark = [tag("title", start.name), tag("circle", cx=x, cy=y, r=3, fill=fill, class_="start")]
        if start.failed:
            mark.append(tag("path", d=f"M{x - 5} {y - 5}l10 10m0 -10l-10 10", class_="cross"))
        parts.append(tag("a", *mark, href=start.href))
    return tag(
        "svg",
        tag("title", "Start places and goals from above"),
        *parts,
        viewBox=f"0 0 {_EDGE + _SIDE} {_SIDE + 24}",
        class_="map",
    )


def phase_bar(spans: Sequence[PhaseSpan], num_frames: int, moments: int, colours: dict[str, str]) -> Markup:
    """The phases in time, so that the middle of each of a filmstrip's pictures stands over its own moment.

    Args:
        spans: The phases.
        num_frames: Of the episode.
        moments: Pictures in the filmstrip above.
        colours: Phase -> its colour; new phases are added.
    """
    last = max(num_frames - 1, 1)
    parts = []
    for span in spans:
        left = 0.5 + (moments - 1) * span.first / last
        right = 0.5 + (moments - 1) * min(span.end, last) / last
        fill = colours.setdefault(span.name, "#" + bytes(PHASES[len(colours) % len(PHASES)]).hex())
        words = f"{span.name}, frames {span.first} to {span.end - 1}"
        parts.append(tag("rect", tag("title", words), x=left, y=0, width=max(right - left, 0.0), height=1, fill=fill))
    return tag(
        "svg", *parts, viewBox=f"0 0 {moments} 1", preserveAspectRatio="none", class_="phases", aria_hidden="true"
    )
