"""A report as one HTML file without network access, fonts or libraries, readable without scripts.

The templates in templates/ hold all markup. Their output is escaped, and invisible characters are spelled out, so no
text from a file can act on the page.
"""

from __future__ import annotations

import base64
import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from jinja2.environment import TemplateStream
from markupsafe import Markup
from numpy.typing import NDArray

from demorec.check.base import Finding
from demorec.core.replacing import REPORT_MARK
from demorec.core.text import printable
from demorec.extensions.report import charts
from demorec.extensions.report.charts import Chart, css_color
from demorec.extensions.report.content import MAX_SAMPLES, VERDICTS, Report, ReportedEpisode, State, success_rate
from demorec.extensions.report.filmstrip import MAX_SHOWN
from demorec.view.style import phase_colors

_STATES: dict[State, str] = {
    "unreadable": "unreadable",
    "failed": "failed",
    "flagged": "flagged by checks",
    "unknown": "outcome unknown",
    "succeeded": "succeeded",
}
"""State of an episode -> its label, in the order of the list of episodes."""
_GOOD = ("success at the first try", "success after a retry")


def write_page(report: Report, path: Path) -> int:
    """Write the page to a new file; return its size in bytes. Raises OSError if it cannot be written."""
    _stream(report).dump(str(path), encoding="utf-8")
    return path.stat().st_size


def page(report: Report) -> str:
    """The complete HTML file."""
    return "".join(_stream(report))


def _stream(report: Report) -> TemplateStream:
    shown = _shown(report.episodes)
    phases = (name for _, episode in shown if episode.filmstrip for name, _, _ in episode.phases)
    colors = {name: css_color([channel / 255 for channel in rgb]) for name, rgb in phase_colors(phases).items()}
    style, script = _own_text("page.css"), _own_text("page.js")
    template = _environment().get_template("page.html")
    return template.stream(
        report=report,
        mark=Markup(REPORT_MARK),
        style=style,
        script=script,
        policy=f"default-src 'none'; img-src data:; style-src {_digest(style)}; script-src {_digest(script)}",
        outcomes=_outcomes(report.episodes),
        checks=report.checks if report.checks and report.checks.worst else None,
        rate=success_rate(report.episodes),
        distributions=list(_distributions(report)),
        shown=shown,
        counts=Counter(episode.state for episode in report.episodes),
        colors=colors,
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
    environment.globals.update(charts=charts, verdicts=VERDICTS[::-1], max_samples=MAX_SAMPLES, states=_STATES)
    environment.filters.update(
        fmt=format, base64=lambda data: base64.b64encode(data).decode(), about=_about, place=place, words=_words
    )
    return environment


@cache
def _own_text(name: str) -> Markup:
    return Markup((files("demorec.extensions.report") / "templates" / name).read_text(encoding="utf-8"))


def _digest(content: str) -> str:
    """Hash by which the Content-Security-Policy allows the page's own style and script."""
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
        if episode.outcome is None:
            outcome = "cannot be read" if episode.problem else "not recorded"
        elif episode.outcome.success is None:
            outcome = "not recorded"
        elif not episode.outcome.success:
            outcome = f"failed: {episode.failure}"
        else:
            outcome = _GOOD[episode.outcome.num_retries > 0]
        groups.setdefault(outcome, []).append(number)
    return sorted(groups.items(), key=lambda item: (item[0] in _GOOD, -len(item[1]), item[0]))


def place(finding: Finding) -> str:
    """Frame and message of a finding."""
    return finding.message if finding.frames is None else f"frame {finding.frames[0]}: {finding.message}"


def _about(episode: ReportedEpisode) -> str:
    """Length, retries, seed and source, if known."""
    num_retries = episode.outcome.num_retries if episode.outcome else 0
    parts = [
        f"{episode.num_frames / episode.fps:.1f} s, {episode.num_frames} frames" if episode.num_frames else "",
        f"{num_retries} {'retry' if num_retries == 1 else 'retries'}" if num_retries else "",
        "" if episode.seed is None else f"seed {episode.seed}",
        episode.source,
    ]
    return ", ".join(filter(None, parts))


def _words(episode: ReportedEpisode) -> str:
    """Text that the page's filter searches."""
    parts = [episode.name, episode.instruction, _about(episode), *(flag.check for flag in episode.flags)]
    return " ".join([*parts, episode.failure]).lower()


def _distributions(report: Report) -> Iterator[Chart]:
    by_name: dict[str, list[tuple[str, NDArray[np.float32]]]] = {}
    for (role, name), parts in report.distributions.items():
        by_name.setdefault(name, []).append((role, np.concatenate(parts)))
    for name, series in by_name.items():
        unit = _unit(name) if report.has_units else ""
        yield charts.distribution(f"{name} ({unit})" if unit else name, series)
    seconds = [episode.num_frames / episode.fps for episode in report.episodes if episode.num_frames]
    if len(seconds) > 1:
        lengths = charts.distribution("length of episodes (s)", [("state", np.array(seconds, np.float32))])
        yield lengths._replace(note=f"mean: {np.mean(seconds):.3g}")


def _unit(name: str) -> str:
    """Unit of a component, by its name in `demorec.episode.features`."""
    part = name.rpartition(".")[2]
    if part in ("pos", "delta", "rx", "ry", "rz"):
        return "rad"
    return "m" if part in ("width", "x", "y", "z", "dx", "dy", "dz") else ""
