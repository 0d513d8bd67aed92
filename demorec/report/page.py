"""A report as one HTML file: no network, no font, no library; scripts are not needed for reading it."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from demorec.check.coverage import MIN_VALUES, drawn_columns, randomised, with_unit
from demorec.errors import ConfigError
from demorec.evaluate.statistics import Rate
from demorec.geometry import Array
from demorec.report.charts import Place, coverage, distribution, floor_map
from demorec.report.content import CheckSummary, Report, ReportedEpisode
from demorec.report.episodes import anchor, episode_list, measured
from demorec.report.histogram import Histogram
from demorec.report.markup import Markup, joined, table, tag
from demorec.safety.replacing import REPORT, REPORT_MARK, written_whole
from demorec.scene.episode import EpisodeInfo
from demorec.scene.features import ACTION, STATE

_NAMED = 5
"""Episodes that a line of a table links to."""
_MOST_POINTS = 4000
"""Of the map of starts and goals."""


def write_page(report: Report, path: Path) -> int:
    """Write the page beside its place, then put it there; return its size in bytes.

    Raises:
        ConfigError: The file cannot be written; then none is there, or the one that was there before.
    """
    data = page(report).encode()
    try:
        with written_whole(path, REPORT) as part:
            part.write_bytes(data)
    except OSError as error:
        raise ConfigError(f"The report cannot be written ({error.strerror or error}): {path}") from error
    return len(data)


def page(report: Report) -> str:
    """The whole file."""
    sections = [
        ("outcomes", "Outcomes", joined(_outcomes(report.episodes))),
        ("checks", "Checks", joined(_checks(report))),
        ("coverage", "Coverage of what is randomised", joined(_coverage(report.episodes))),
        ("distributions", "Distributions", joined(_distributions(report))),
        ("origin", "Origin", joined(_origin(report))),
        ("episodes", "Episodes", joined(episode_list(report.episodes))),
    ]
    there = [section for section in sections if section[2]]
    style, script = _resource("page.css"), _resource("page.js")
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", http_equiv="Content-Security-Policy", content=_policy(style, script)),
        tag("title", f"{report.title}: demorec report"),
        tag("style", Markup(style)),
    )
    body = tag(
        "body",
        tag(
            "main",
            tag("h1", report.title),
            tag("div", report.kind, class_="kind"),
            tag("nav", *(tag("a", title, href=f"#{name}") for name, title, _ in there)),
            tag("dl", *(tag("div", tag("dt", name), tag("dd", value)) for name, value in report.facts), class_="facts"),
            _missing(report.missing),
            *(tag("section", tag("h2", title), content, id=name) for name, title, content in there),
        ),
        tag("script", Markup(script)),
    )
    return f"{REPORT_MARK}{tag('html', head, body, lang='en')}\n"


@cache
def _resource(name: str) -> str:
    return (files("demorec.report") / name).read_text(encoding="utf-8")


def _policy(style: str, script: str) -> str:
    """What a browser may do with the page: show its pictures and run this style and this script, nothing else."""

    def digest(content: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"

    return f"default-src 'none'; img-src data:; style-src {digest(style)}; script-src {digest(script)}"


def _missing(sentences: Sequence[str]) -> Markup | None:
    if not sentences:
        return None
    return tag("section", tag("p", "Not in this report:"), tag("ul", *(tag("li", words) for words in sentences)))


# --------------------------------------------------------------------------------------------------------- outcomes


def _outcomes(episodes: Sequence[ReportedEpisode]) -> Iterator[Markup]:
    groups: dict[str, list[int]] = {}
    for number, episode in enumerate(episodes):
        groups.setdefault(_outcome(episode), []).append(number)
    good = ("success at the first try", "success after a retry")
    order = sorted(groups, key=lambda name: (name in good, -len(groups[name]), name))
    rows = [
        (
            name,
            len(groups[name]),
            f"{100 * len(groups[name]) / len(episodes):.1f}\u00a0%",
            _links(groups[name], episodes),
        )
        for name in order
    ]
    known = [episode.success for episode in episodes if episode.success is not None]
    if known:
        rate = Rate(successes=sum(known), trials=len(known))
        low, high = rate.interval
        yield tag(
            "p",
            f"{rate.successes} of {rate.trials} attempts succeeded: {100 * rate.value:.1f} %, with a 95 % interval of "
            f"{100 * low:.1f} to {100 * high:.1f} %.",
        )
    yield table(("outcome", "attempts", "share", "episodes"), rows)


def _outcome(episode: ReportedEpisode) -> str:
    if episode.success is None:
        return "cannot be read" if episode.problem else "not told"
    if not episode.success:
        return f"failed: {episode.failure}"
    return "success after a retry" if episode.num_retries else "success at the first try"


def _links(numbers: Sequence[int], episodes: Sequence[ReportedEpisode]) -> Markup:
    links = [tag("a", episodes[number].name, href=f"#{anchor(number)}") for number in numbers[:_NAMED]]
    between = [part for link in links for part in (", ", link)][1:]
    return joined([*between, ", ..." if len(numbers) > _NAMED else ""])


# ----------------------------------------------------------------------------------------------------------- checks


def _checks(report: Report) -> Iterator[Markup]:
    checks = report.checks
    if checks is None or not checks.by_name:
        return
    found: dict[str, list[tuple[str, CheckSummary]]] = {}
    for name, summary in checks.by_name.items():
        found.setdefault(summary.worst.level, []).append((name, summary))
    counts = ", ".join(
        f"{len(found.get(level, ()))} {words}"
        for level, words in (("fail", "failed"), ("warn", "warned"), ("pass", "passed"), ("skip", "not measured"))
    )
    apart = ""
    if any(episode.success is False for episode in report.episodes):
        apart = " Of attempts that failed only the files are judged here; what else was found in them stands with each."
    subjects = "file" if checks.num_subjects == 1 else "files and folders"
    yield tag("p", f"Of {len(checks.by_name)} checks over {checks.num_subjects} {subjects}: {counts}.{apart}")
    bad = [*found.get("fail", ()), *found.get("warn", ())]
    head = ("check", "worst", "found", "allowed", "where", "how often")
    if bad:
        yield table(head, (_check_row(name, summary) for name, summary in bad))
    rest = [*found.get("pass", ()), *found.get("skip", ())]
    if rest:
        unmeasured = f", and {len(found['skip'])} not measured" if "skip" in found else ""
        words = f"{len(found.get('pass', ()))} checks that passed, with the worst value of each{unmeasured}"
        yield tag("details", tag("summary", words), table(head, (_check_row(name, summary) for name, summary in rest)))


def _check_row(name: str, summary: CheckSummary) -> tuple[object, ...]:
    value, allowed, where = measured(summary.worst)
    level = summary.worst.level
    often = ", ".join(
        f"{summary.counts[key]} {key}" for key in ("fail", "warn", "pass", "skip") if key in summary.counts
    )
    place = ": ".join(filter(None, (summary.where, where)))
    return name, tag("span", level, class_=level), value, allowed, place, often


# --------------------------------------------------------------------------------------------------------- coverage


def _coverage(episodes: Sequence[ReportedEpisode]) -> Iterator[Markup]:
    by_task: dict[str, list[tuple[int, ReportedEpisode, EpisodeInfo]]] = {}
    for number, episode in enumerate(episodes):
        if episode.info is not None:
            by_task.setdefault(episode.info.task, []).append((number, episode, episode.info))
    for task, members in by_task.items():
        if len(by_task) > 1:
            yield tag("h3", task)
        yield from _task_coverage(members)


def _task_coverage(members: Sequence[tuple[int, ReportedEpisode, EpisodeInfo]]) -> Iterator[Markup]:
    infos = [info for _, _, info in members]
    failed = np.array([episode.success is False for _, episode, _ in members])
    starts, goals = _places(members[:: max(1, -(-len(members) // _MOST_POINTS))])
    left = tag("div", floor_map(starts, goals)) if starts else None
    legend = ["dots: where objects start, in their colour", "rings: goals"] if starts else []
    if starts and failed.any():
        legend.append("crosses: attempts that failed")
    scenes = [_covered(with_unit(name), values, failed) for name, values in randomised(infos).items()]
    if scenes:
        in_red = f", failures in red, {int(failed.sum())} in all" if failed.any() else ""
        legend.append(f"bars: attempts in each part of the range{in_red}")
    elif len(infos) < MIN_VALUES:
        there = "1 is there" if len(infos) == 1 else f"{len(infos)} are there"
        scenes = [tag("p", f"From {MIN_VALUES} episodes on the ranges of what is drawn are shown; {there}.")]
    else:
        scenes = [tag("p", f"No quantity of the scenes takes {MIN_VALUES} different values.")]
    yield tag("div", *(tag("span", words) for words in legend), class_="legend")
    right = tag("div", *scenes, class_="charts")
    yield tag("div", left, right, class_="split") if left else right
    behaviour = drawn_columns([info.behaviour for info in infos])
    if behaviour:
        charts = [_covered(name.replace("_", " "), values, failed) for name, values in behaviour.items()]
        words = f"{len(charts)} more numbers drawn for each episode: the expert's manner, noise, calibration errors"
        yield tag("details", tag("summary", words), tag("div", *charts, class_="charts"))


def _covered(name: str, values: Array, failed: NDArray[np.bool_]) -> Markup:
    return tag("figure", tag("figcaption", name), coverage(values, failed, name))


def _places(members: Sequence[tuple[int, ReportedEpisode, EpisodeInfo]]) -> tuple[list[Place], list[Place]]:
    starts: list[Place] = []
    goals: list[Place] = []
    for number, episode, info in members:
        scene = info.scene
        for goal in scene.goals:
            body = scene.body(goal.object)
            for places, position in (
                (starts, body.world_from_body.position),
                (goals, scene.world_from_goal(goal).position),
            ):
                places.append(
                    Place(
                        x=float(position[0]),
                        y=float(position[1]),
                        rgba=tuple(body.rgba),
                        href=f"#{anchor(number)}",
                        name=f"{episode.name}: {goal.object}",
                        failed=episode.success is False,
                    )
                )
    return starts, goals


# ---------------------------------------------------------------------------------------------------- distributions


def _distributions(report: Report) -> Iterator[Markup]:
    by_name: dict[str, list[tuple[str, Histogram]]] = {}
    for (feature, name), histogram in report.distributions.items():
        if histogram.count:
            by_name.setdefault(name, []).append((_CURVES[feature], histogram))
    figures = []
    for name, series in by_name.items():
        unit = _unit(name) if report.has_units else ""
        caption = f"{name} ({unit})" if unit else name
        mean = ", ".join(f"{curve} {histogram.mean:.3g}" for curve, histogram in series)
        figures.append(
            tag(
                "figure",
                tag("figcaption", caption, tag("div", f"mean: {mean}", class_="soft")),
                distribution(series, f"distribution of {name}"),
            )
        )
    lengths = Histogram()
    lengths.add(np.array([episode.num_frames / episode.fps for episode in report.episodes if episode.num_frames]))
    if lengths.count > 1:
        caption = tag("figcaption", "length of episodes (s)", tag("div", f"mean: {lengths.mean:.3g}", class_="soft"))
        figures.append(tag("figure", caption, distribution([("state", lengths)], "length of episodes")))
    if not figures:
        return
    odd = sum(histogram.not_finite for histogram in report.distributions.values())
    if odd:
        yield tag("p", f"{odd:,} values are no finite numbers and are left out.", class_="fail")
    yield tag("p", "Of all frames: the filled area is the state, the line the action; ends are the extremes.")
    yield tag("div", *figures, class_="charts")


def _unit(name: str) -> str:
    """Of a component as `demorec.scene.features` names it."""
    part = name.rpartition(".")[2]
    if part in ("pos", "delta", "rx", "ry", "rz"):
        return "rad"
    return "m" if part in ("width", "x", "y", "z", "dx", "dy", "dz") else ""


_CURVES = {STATE: "state", ACTION: "action"}


def _origin(report: Report) -> Iterator[Markup]:
    for config in report.configs:
        name = " ".join(str(config[key]) for key in ("task", "robot", "seed") if key in config)
        text = json.dumps(config, indent=2, ensure_ascii=False)
        yield tag("details", tag("summary", f"configuration {name}"), tag("pre", *_lines(text)))


def _lines(text: str) -> Iterator[object]:
    """Lines, whose ends are the page's own."""
    for line in text.split("\n"):
        yield line
        yield Markup("\n")
