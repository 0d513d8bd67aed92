"""The list of episodes on a page, those that need attention first."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from demorec.check.base import Level, Result
from demorec.report.charts import phase_bar
from demorec.report.content import STATES, ReportedEpisode, State
from demorec.report.markup import Markup, table, tag

MOST_SHOWN = 4000
"""Episodes that a page shows one by one."""

WORDS: dict[State, str] = {
    "unreadable": "unreadable",
    "failed": "failed",
    "flagged": "flagged by checks",
    "unknown": "outcome unknown",
    "succeeded": "succeeded",
}


_LEVELS: Mapping[Level, str] = {"fail": "failed", "warn": "warned"}


def episode_list(episodes: Sequence[ReportedEpisode]) -> Iterator[Markup]:
    """Legend, filters and one entry an episode."""
    shown = _shown(episodes)
    counts = Counter(episode.state for episode in episodes)
    first = [WORDS[state] for state in STATES if counts[state] and state not in ("unknown", "succeeded")]
    order = f"First come those marked {', '.join(first)}. " if first else ""
    yield tag(
        "p",
        f"{order}A filmstrip runs from the first frame to the last; the bar below it shows the phases, so that the "
        "middle of each picture stands over its moment.",
    )
    if len(shown) < len(episodes):
        yield tag(
            "p",
            f"Shown are {len(shown)} of {len(episodes)} episodes: those that failed or were flagged, as far as there "
            "is room, and others evenly spaced. All tables and plots count every episode.",
        )
    colours: dict[str, str] = {}
    entries = [_entry(number, episode, colours) for number, episode in shown]
    if colours:
        yield tag(
            "div",
            *(tag("span", _swatch(fill), name) for name, fill in colours.items()),
            class_="legend",
        )
    yield _filters(counts, len(episodes))
    yield from entries


def anchor(number: int) -> str:
    """Where the episode of this number in the report is found on its page."""
    return f"e{number}"


def _shown(episodes: Sequence[ReportedEpisode]) -> list[tuple[int, ReportedEpisode]]:
    """(number, episode), the worst first."""
    stride = max(1, -(-len(episodes) // MOST_SHOWN))
    chosen = [
        (number, episode)
        for number, episode in enumerate(episodes)
        if number % stride == 0 or episode.state not in ("unknown", "succeeded")
    ]
    return sorted(chosen, key=lambda item: STATES.index(item[1].state))[:MOST_SHOWN]


def _swatch(fill: str) -> Markup:
    return tag("svg", tag("rect", width=14, height=10, fill=fill), viewBox="0 0 14 10", aria_hidden="true")


def _filters(counts: Counter[State], total: int) -> Markup:
    buttons = [tag("button", f"all {total}", value="", type="button", aria_pressed="true")]
    buttons += [
        tag("button", f"{WORDS[state]} {counts[state]}", value=state, type="button", aria_pressed="false")
        for state in STATES
        if counts[state]
    ]
    words = tag("input", type="search", placeholder="words of an episode", aria_label="words of an episode")
    return tag("div", *buttons, words, tag("output", class_="soft"), class_="filters", hidden="")


def _entry(number: int, episode: ReportedEpisode, colours: dict[str, str]) -> Markup:
    retries = f"{episode.num_retries} {'retry' if episode.num_retries == 1 else 'retries'}"
    about = [
        f"{episode.num_frames / episode.fps:.1f} s, {episode.num_frames} frames" if episode.num_frames else "",
        retries if episode.num_retries else "",
        "" if episode.seed is None else f"seed {episode.seed}",
        episode.source,
    ]
    words = [episode.name, episode.instruction, *about, *(flag.check for flag in episode.flags)]
    if episode.success is False:
        words.append(episode.failure)
    return tag(
        "article",
        tag(
            "h3",
            tag("span", episode.name),
            tag("span", WORDS[episode.state], class_=f"badge {episode.state}"),
            tag("span", ", ".join(filter(None, about)), class_="soft"),
        ),
        tag("p", episode.instruction) if episode.instruction else None,
        tag("p", f"Failed: {episode.failure}.", class_="fail") if episode.success is False else None,
        tag("p", episode.problem, class_="warn" if episode.success is False else "fail") if episode.problem else None,
        _strip(episode, colours),
        _conditions(episode),
        _flags(episode),
        id=anchor(number),
        class_=episode.state,
        data_words=" ".join(words).lower(),
    )


def _strip(episode: ReportedEpisode, colours: dict[str, str]) -> Markup | None:
    strip = episode.filmstrip
    if strip is None:
        return None
    seconds = (episode.num_frames - 1) / episode.fps
    image = tag(
        "img",
        src=f"data:image/jpeg;base64,{base64.b64encode(strip.jpeg).decode()}",
        alt=f"{strip.moments} pictures of camera {strip.camera}, from 0 to {seconds:.1f} s",
        width=strip.width,
        height=strip.height,
        decoding="async",
        loading="lazy",
    )
    bar = phase_bar(episode.phases, episode.num_frames, strip.moments, colours) if episode.phases else None
    return tag("div", tag("div", image, bar), class_="strip")


def _conditions(episode: ReportedEpisode) -> Markup | None:
    """The task's conditions of an episode that failed; those that do not hold first."""
    if episode.success is not False or not episode.conditions:
        return None
    rows = [
        (
            condition.name,
            f"{condition.value:.4g} {condition.unit}",
            f"{condition.limit:.4g} {condition.unit}",
            "holds" if condition.passed else tag("span", "does not hold", class_="fail"),
        )
        for condition in sorted(episode.conditions, key=lambda condition: condition.passed)
    ]
    return tag("details", tag("summary", "conditions of success"), table(("condition", "value", "limit", ""), rows))


def _flags(episode: ReportedEpisode) -> Markup | None:
    if not episode.flags:
        return None
    rows = [(tag("span", flag.level, class_=flag.level), flag.check, *measured(flag)) for flag in episode.flags]
    counts = Counter(flag.level for flag in episode.flags)
    words = "checks: " + ", ".join(f"{counts[level]} {word}" for level, word in _LEVELS.items() if counts[level])
    if episode.success is False:
        words += ", as is to be expected of an attempt that failed"
    return tag("details", tag("summary", words), table(("level", "check", "found", "allowed", "where"), rows))


def measured(result: Result) -> tuple[str, str, str]:
    """What was found, what is allowed, and where."""
    unit = f" {result.unit}" if result.unit else ""
    value = "" if result.value is None else f"{result.value:.4g}{unit}"
    frame = "" if result.frame is None else f"frame {result.frame}"
    where = ": ".join(filter(None, (frame, result.detail)))
    return value, f"{result.allowed:.4g}{unit}" if result.level in ("warn", "fail", "pass") else "", where
