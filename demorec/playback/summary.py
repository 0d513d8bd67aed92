"""An episode in words and numbers."""

from __future__ import annotations

import re

from demorec.playback.episode import PlayedEpisode

_OF_A_RUN = re.compile(r"episode_0*(?P<number>\d+)(?:\.attempt_(?P<attempt>\d+))?")


def entry(episode: PlayedEpisode) -> str:
    """A few characters for the viewer's narrow list: "3 ok", "0.1 FAIL place" (the attempt after the dot)."""
    match = _OF_A_RUN.fullmatch(episode.name)
    name = episode.name if match is None else ".".join(part for part in match.groups() if part is not None)
    if episode.outcome is None:
        return f"{name} ?"
    return f"{name} ok" if episode.outcome.success else f"{name} FAIL {episode.outcome.failure_phase}".rstrip()


def properties(episode: PlayedEpisode) -> dict[str, str | int | float | bool]:
    """What the viewer lists beside the recording's name."""
    info, outcome = episode.info, episode.outcome
    values: dict[str, str | int | float | bool] = {
        "task": info.task,
        "instruction": info.instruction,
        "outcome": episode.verdict,
        "seconds": round(episode.duration, 3),
        "frames": episode.num_frames,
        "seed": info.root_seed,
        "episode": info.episode_index,
        "attempt": info.attempt,
        "robot": info.robot.name,
        "source": episode.source,
    }
    if outcome is not None:
        values["success"] = outcome.success
        values["retries"] = outcome.num_retries
    if info.config_digest:
        values["config_digest"] = info.config_digest
    if info.origin:
        values["origin"] = info.origin
    return values


def summary(episode: PlayedEpisode) -> str:
    """Markdown: task, outcome and its checks, the failed ones first."""
    info = episode.info
    lines = [
        f"**{info.instruction}**",
        "",
        f"{info.task} · episode {info.episode_index} · seed {info.root_seed}",
        "",
        f"{episode.duration:.1f} s · {episode.num_frames} frames",
        "",
        f"Outcome: **{episode.verdict}**",
    ]
    if info.origin:
        lines += ["", info.origin]
    if episode.outcome is not None and episode.outcome.checks:
        lines += ["", "| | check | value | limit |", "|---|---|---|---|"]
        for check in sorted(episode.outcome.checks, key=lambda check: check.passed):
            mark = "✓" if check.passed else "**✗**"
            unit = f" {check.unit}" if check.unit else ""
            lines.append(f"| {mark} | {check.name} | {check.value:.3g}{unit} | {check.limit:.3g}{unit} |")
    return "\n".join(lines) + "\n"
