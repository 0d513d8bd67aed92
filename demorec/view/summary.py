"""An episode in words and numbers."""

from __future__ import annotations

import re

from demorec.episode.episode import Outcome
from demorec.view.episode import PlayedEpisode, PlayedExternal

_NUMBERED = re.compile(r"^episode_0*(?=\d)")
_OF_A_RUN = re.compile(r"episode_0*(?P<number>\d+)(?:\.attempt_(?P<attempt>\d+))?")


def entry(episode: PlayedEpisode | PlayedExternal) -> str:
    """A few characters for the viewer's narrow list: "3 ok", "0.1 FAIL place" (the attempt after the dot)."""
    if isinstance(episode, PlayedExternal):
        name, phase = _NUMBERED.sub("", episode.name), ""
    else:
        match = _OF_A_RUN.fullmatch(episode.name)
        name = episode.name if match is None else ".".join(part for part in match.groups() if part is not None)
        phase = "" if episode.outcome is None else episode.outcome.failure_phase
    if episode.outcome is None or episode.outcome.success is None:
        return f"{name} ?"
    return f"{name} ok" if episode.outcome.success else f"{name} FAIL {phase}".rstrip()


def properties(episode: PlayedEpisode | PlayedExternal) -> dict[str, str | int | float | bool]:
    """What the viewer lists beside the recording's name."""
    if isinstance(episode, PlayedExternal):
        return {
            "instruction": episode.info.instruction,
            "outcome": episode.verdict,
            "frames": episode.num_frames,
            "robot": episode.info.robot,
            "origin": episode.info.origin.kind,
            "source": episode.source,
        }
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
        values["success"] = bool(outcome.success)
        values["retries"] = outcome.num_retries
    if info.config_digest:
        values["config_digest"] = info.config_digest
    if info.origin:
        values["origin"] = info.origin
    return values


def summary(episode: PlayedEpisode | PlayedExternal) -> str:
    """Markdown: task, outcome and its checks, the failed ones first."""
    if isinstance(episode, PlayedExternal):
        seconds = float(episode.time_ns[-1]) / 1e9 if episode.num_frames else 0.0
        about = f"{episode.info.robot} · episode {episode.info.episode_index}"
        length = f"{seconds:.1f} s · {episode.num_frames} frames (nominal {episode.info.fps} Hz)"
        files = (file.name for file in episode.info.origin.files)
        origin, checks = f"Origin: {', '.join([episode.info.origin.kind, *files])}", []
    else:
        about = f"{episode.info.task} · episode {episode.info.episode_index} · seed {episode.info.root_seed}"
        length = f"{episode.duration:.1f} s · {episode.num_frames} frames"
        origin, checks = episode.info.origin, [] if episode.outcome is None else _checks(episode.outcome)
    parts = [f"**{episode.info.instruction}**", about, length, f"Outcome: **{episode.verdict}**", origin, *checks]
    return "\n\n".join(filter(None, parts)) + "\n"


def _checks(outcome: Outcome) -> list[str]:
    """A table of the conditions of success, the failed ones first."""
    rows = ["| | check | value | limit |", "|---|---|---|---|"]
    for check in sorted(outcome.checks, key=lambda check: check.passed):
        mark = "✓" if check.passed else "**✗**"
        unit = f" {check.unit}" if check.unit else ""
        rows.append(f"| {mark} | {check.name} | {check.value:.3g}{unit} | {check.limit:.3g}{unit} |")
    return ["\n".join(rows)] if outcome.checks else []
