"""Geometry of the page's charts, which templates/charts.html draws as SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.extensions.report.content import ReportedEpisode

WIDTH = 220
"""Width of a chart without its labels, in units of its SVG."""
HEIGHT = 70
"""Height of a chart without its labels, in the same units."""
_BINS = 48


class Chart(NamedTuple):
    """A small chart: areas and lines over a range of values.

    Attributes:
        title: The quantity and its unit.
        paths: (CSS class, SVG path).
        low, high, middle: Labels below its left end, its right end and its middle.
        note: Text below the title.
    """

    title: str
    paths: list[tuple[str, str]]
    low: str
    high: str
    middle: str = ""
    note: str = ""


def distribution(title: str, series: Sequence[tuple[str, NDArray[np.float32]]]) -> Chart:
    """Draw the densities of one or two components over their common range; `series` has the CSS class and the values of
    each.
    """
    note = "mean: " + ", ".join(f"{name} {values.mean():.3g}" for name, values in series)
    low = min(float(values.min()) for _, values in series)
    high = max(float(values.max()) for _, values in series)
    if low == high:  # the bin of a single value would be too narrow to see
        bar = f"M{WIDTH / 2 - 2:g} 0h4v{HEIGHT}h-4z"
        return Chart(title, [(series[0][0], bar)], "", "", f"{low:.3g}", note)
    counts = {name: np.histogram(values, bins=_BINS, range=(low, high))[0] / len(values) for name, values in series}
    highest = max(float(shares.max()) for shares in counts.values())
    paths = []
    for name, shares in counts.items():
        steps = "".join(f"V{HEIGHT * (1 - share / highest):.1f}h{WIDTH / _BINS:.3f}" for share in shares)
        paths.append((name, f"M0 {HEIGHT}{steps}V{HEIGHT}"))
    return Chart(title, paths, f"{low:.3g}", f"{high:.3g}", "", note)


def css_color(rgb: Sequence[float]) -> str:
    """CSS color for red, green and blue in 0..1."""
    return "#" + "".join(f"{round(255 * min(max(channel, 0.0), 1.0)):02x}" for channel in rgb[:3])


def phase_bar(episode: ReportedEpisode, moments: int, colors: Mapping[str, str]) -> list[tuple[str, str, str, str]]:
    """(title, left, width, color) of each phase, in units of one image of the filmstrip above.

    The middle of each image is above its own moment.
    """
    last = max(episode.num_frames - 1, 1)
    bars = []
    for name, first, end in episode.phases:
        left, right = (0.5 + (moments - 1) * min(frame, last) / last for frame in (first, end))
        title = f"{name}, frames {first} to {end - 1}"
        bars.append((title, f"{left:.6g}", f"{right - left:.6g}", colors[name]))
    return bars
