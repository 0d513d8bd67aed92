"""An episode in words and numbers."""

from __future__ import annotations

import re

from demorec.episode.episode import Outcome
from demorec.view.episode import PlayedEpisode

_OF_A_RUN = re.compile(r"episode_0*(?P<number>\d+)(?:\.attempt_(?P<attempt>\d+))?")


def entry(episode: PlayedEpisode) -> str:
    """A few characters for the viewer's narrow list: "3 ok", "0.1 FAIL place" (the attempt after the dot)."""
    match, outcome = _OF_A_RUN.fullmatch(episode.name), episode.outcome
    name = episode.name if match is None else ".".join(part for part in match.groups() if part is not None)
    if outcome is None or outcome.success is None:
        return f"{name} ?"
    return f"{name} ok" if outcome.success else f"{name} FAIL {outcome.failure_phase}".rstrip()


def properties(episode: PlayedEpisode) -> dict[str, str | int | float | bool]:
    """What the viewer lists beside the recording's name."""
    info, simulated, outcome = episode.info, episode.simulated, episode.outcome
    values: dict[str, str | int | float | bool] = {
        "instruction": info.instruction,
        "outcome": episode.verdict,
        "seconds": round(episode.duration, 3),
        "frames": episode.num_frames,
        "episode": info.episode_index,
        "robot": info.robot_name,
        "source": episode.source,
    }
    if outcome is not None and outcome.success is not None:
        values["success"] = outcome.success
    if simulated is not None:
        values |= {"task": simulated.task, "seed": simulated.root_seed, "attempt": simulated.attempt}
        values |= {} if outcome is None else {"retries": outcome.num_retries}
        values |= {"config_digest": simulated.config_digest} if simulated.config_digest else {}
    if origin := _origin(episode):
        values["origin"] = origin
    return values


def _origin(episode: PlayedEpisode) -> str:
    """Where it comes from, "" for a generated one."""
    origin = episode.info.origin
    return origin if isinstance(origin, str) else ", ".join([origin.kind, *(file.name for file in origin.files)])


def summary(episode: PlayedEpisode) -> str:
    """Markdown: task, outcome and its checks, the failed ones first."""
    info, simulated = episode.info, episode.simulated
    about = [info.robot_name if simulated is None else simulated.task, f"episode {info.episode_index}"]
    about += [] if simulated is None else [f"seed {simulated.root_seed}"]
    length = f"{episode.duration:.1f} s · {episode.num_frames} frames (nominal {info.fps} Hz)"
    origin, checks = _origin(episode), [] if episode.outcome is None else _checks(episode.outcome)
    parts = [f"**{info.instruction}**", " · ".join(about), length, f"Outcome: **{episode.verdict}**"]
    return "\n\n".join([*parts, *([f"Origin: {origin}"] if origin else []), *checks]) + "\n"


def _checks(outcome: Outcome) -> list[str]:
    """A table of the conditions of success, the failed ones first."""
    rows = ["| | check | value | limit |", "|---|---|---|---|"]
    for check in sorted(outcome.checks, key=lambda check: check.passed):
        mark = "✓" if check.passed else "**✗**"
        unit = f" {check.unit}" if check.unit else ""
        rows.append(f"| {mark} | {check.name} | {check.value:.3g}{unit} | {check.limit:.3g}{unit} |")
    return ["\n".join(rows)] if outcome.checks else []
