"""A report as one HTML file without network access, fonts, libraries or scripts.

The templates in templates/ hold all markup. Their output is escaped, and invisible characters are spelled out, so no
text from a file can act on the page.
"""

from __future__ import annotations

import base64
import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from jinja2.environment import TemplateStream
from markupsafe import Markup
from numpy.typing import NDArray

from demorec.check.base import RANK, Finding
from demorec.core.replacing import REPORT_MARK
from demorec.core.text import printable
from demorec.extensions.doctor.diagnosis import Diagnosis
from demorec.extensions.report.filmstrip import MAX_SHOWN
from demorec.extensions.report.gather import MAX_SAMPLES, Report, ReportedEpisode, State, success_rate

CHART_WIDTH = 220
"""Width of a chart without its labels, in units of its SVG."""
CHART_HEIGHT = 70
"""Height of a chart without its labels, in the same units."""
_BINS = 48
_STATES: dict[State, str] = {
    "unreadable": "unreadable",
    "failed": "failed",
    "flagged": "flagged by checks",
    "unknown": "outcome unknown",
    "succeeded": "succeeded",
}
"""State of an episode -> its label, in the order of the list of episodes."""
_SUCCESS = "success"


def write_page(report: Report, path: Path) -> int:
    """Write the page to a new file; return its size in bytes. Raises OSError if it cannot be written."""
    _stream(report).dump(str(path), encoding="utf-8")
    return path.stat().st_size


def page(report: Report) -> str:
    """The complete HTML file."""
    return "".join(_stream(report))


def _stream(report: Report) -> TemplateStream:
    style = Markup((files("demorec.extensions.report") / "templates" / "page.css").read_text(encoding="utf-8"))
    template = _environment().get_template("page.html")
    return template.stream(
        report=report,
        mark=Markup(REPORT_MARK),
        style=style,
        policy=f"default-src 'none'; img-src data:; style-src {_digest(style)}",
        outcomes=_outcomes(report.episodes),
        findings=[] if report.diagnosis is None else list(_findings(report.diagnosis)),
        rate=success_rate(report.episodes),
        distributions=list(_distributions(report)),
        shown=_shown(report.episodes),
        counts=Counter(episode.state for episode in report.episodes),
    )


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("demorec.extensions.report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: value if isinstance(value, Markup) else printable(str(value)),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals.update(max_samples=MAX_SAMPLES, states=_STATES, width=CHART_WIDTH, height=CHART_HEIGHT)
    environment.filters.update(
        fmt=format, base64=lambda data: base64.b64encode(data).decode(), about=_about, place=_place
    )
    return environment


def _digest(content: str) -> str:
    """Hash by which the Content-Security-Policy allows the page's own style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"


def _shown(episodes: Sequence[ReportedEpisode]) -> list[tuple[int, ReportedEpisode]]:
    """(number, episode), sorted by need for attention; among flagged ones the worst scores first."""
    stride = max(1, -(-len(episodes) // MAX_SHOWN))
    chosen = [
        (number, episode)
        for number, episode in enumerate(episodes)
        if number % stride == 0 or episode.state not in ("unknown", "succeeded")
    ]

    def urgency(item: tuple[int, ReportedEpisode]) -> tuple[int, float]:
        return list(_STATES).index(item[1].state), item[1].score

    return sorted(chosen, key=urgency)[:MAX_SHOWN]


def _outcomes(episodes: Sequence[ReportedEpisode]) -> list[tuple[str, list[int]]]:
    """(outcome, numbers of its episodes), failures first."""
    groups: dict[str, list[int]] = {}
    for number, episode in enumerate(episodes):
        if episode.outcome is None or episode.success is None:
            outcome = "cannot be read" if episode.outcome is None and episode.problem else "not recorded"
        elif not episode.success:
            outcome = f"failed: {episode.failure}"
        else:
            outcome = _SUCCESS
        groups.setdefault(outcome, []).append(number)
    return sorted(groups.items(), key=lambda item: (item[0] == _SUCCESS, -len(item[1]), item[0]))


def _findings(diagnosis: Diagnosis) -> Iterator[tuple[Finding, str]]:
    """Yield the worst finding of each check, broken ones first, and the number of its findings by severity."""
    groups: dict[str, list[Finding]] = {}
    for finding in sorted(diagnosis.findings, key=lambda finding: -RANK[finding.severity]):
        groups.setdefault(finding.check, []).append(finding)
    for found in groups.values():
        counts = Counter(finding.severity for finding in found)
        yield found[0], ", ".join(f"{count} {severity}" for severity, count in counts.items())


def _place(finding: Finding) -> str:
    """Frame and message of a finding."""
    return finding.message if finding.frames is None else f"frame {finding.frames[0]}: {finding.message}"


def _about(episode: ReportedEpisode) -> str:
    """Length, retries and source, if known."""
    num_retries = episode.outcome.num_retries if episode.outcome else 0
    parts = [
        f"{episode.num_frames / episode.fps:.1f} s, {episode.num_frames} frames" if episode.num_frames else "",
        f"{num_retries} {'retry' if num_retries == 1 else 'retries'}" if num_retries else "",
        episode.source,
    ]
    return ", ".join(filter(None, parts))


class Chart(NamedTuple):
    """A small chart: areas and lines over a range of values.

    Attributes:
        title: The quantity.
        paths: (CSS class, SVG path).
        low, high, middle: Labels below its left end, its right end and its middle.
        note: Text below the title.
    """

    title: str
    paths: list[tuple[str, str]]
    low: str
    high: str
    middle: str
    note: str


def distribution(title: str, series: Mapping[str, NDArray[np.float32]]) -> Chart:
    """Draw the densities of one or two components over their common range; `series` is CSS class -> values."""
    note = "mean: " + ", ".join(f"{name} {values.mean():.3g}" for name, values in series.items())
    low = min(float(values.min()) for values in series.values())
    high = max(float(values.max()) for values in series.values())
    if low == high:  # the bin of a single value would be too narrow to see
        bar = f"M{CHART_WIDTH / 2 - 2:g} 0h4v{CHART_HEIGHT}h-4z"
        return Chart(title, [(next(iter(series)), bar)], "", "", f"{low:.3g}", note)
    shares = {
        name: np.histogram(values, bins=_BINS, range=(low, high))[0] / len(values) for name, values in series.items()
    }
    highest = max(float(found.max()) for found in shares.values())
    paths = []
    for name, found in shares.items():
        steps = "".join(f"V{CHART_HEIGHT * (1 - share / highest):.1f}h{CHART_WIDTH / _BINS:.3f}" for share in found)
        paths.append((name, f"M0 {CHART_HEIGHT}{steps}V{CHART_HEIGHT}"))
    return Chart(title, paths, f"{low:.3g}", f"{high:.3g}", "", note)


def _distributions(report: Report) -> Iterator[Chart]:
    by_name: dict[str, dict[str, NDArray[np.float32]]] = {}
    for (role, name), parts in report.distributions.items():
        by_name.setdefault(name, {})[role] = np.concatenate(parts)
    for name, series in by_name.items():
        yield distribution(name, series)
    seconds = [episode.num_frames / episode.fps for episode in report.episodes if episode.num_frames]
    if len(seconds) > 1:
        lengths = distribution("length of episodes (s)", {"state": np.array(seconds, np.float32)})
        yield lengths._replace(note=f"mean: {np.mean(seconds):.3g}")
