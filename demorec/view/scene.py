"""Logging of episodes to Rerun recordings, in words, numbers and columns, and to .rrd files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
import rerun as rr

from demorec.core.errors import RecordingError, write_error
from demorec.episode.simulated import simulation_facts
from demorec.view.bodies import log_bodies, log_robot
from demorec.view.cameras import log_cameras
from demorec.view.episode import FORCE_CURVES, Playback
from demorec.view.layout import episode_layout
from demorec.view.paths import Paths, indexes
from demorec.view.sources import PlaybackSource
from demorec.view.style import ASKED, FORCE, MEASURED, TARGET, Color, name_colors, series_colors

_HEADINGS = {"subtask": "Now", "motion": "Motion", "plan": "Plan", "memory": "So far"}
"""Kind of statement -> its heading, in the order of the page."""
_COLORS = {"gripper": MEASURED, "gripper target": TARGET, FORCE_CURVES: FORCE, "target": ASKED}
_WIDTHS = {"target": 0.7, "gripper target": 1.2}
_LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
_LEVEL_COLORS: dict[str, Color] = {"info": (200, 200, 200), "warning": (255, 200, 60), "error": (255, 80, 80)}


def log_episode(recording: rr.RecordingStream, episode: Playback) -> None:
    """Log a whole episode.

    Raises:
        DemorecError: The source is damaged, or a model is neither installed nor recorded.
    """
    recording.log(Paths.world, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    log_robot(recording, episode)
    log_cameras(recording, episode)
    _log_curves(recording, episode)
    if episode.scene is not None:
        log_bodies(recording, episode, episode.scene)
    _log_ee_path(recording, episode)
    _log_phases(recording, episode)
    _log_events(recording, episode)
    _log_words(recording, episode)
    recording.log(Paths.summary, rr.TextDocument(_summary(episode), media_type="text/markdown"), static=True)


def new_recording(episode: Playback) -> rr.RecordingStream:
    """Create an empty Rerun recording with the episode's name."""
    recording = rr.RecordingStream(_application_id(episode), recording_id=f"{episode.name}-{episode.identity}")
    recording.send_recording_name(_entry(episode))
    return recording


def _application_id(episode: Playback) -> str:
    """Group in the viewer's list: episodes of one group, task and set of cameras share a layout."""
    words = [episode.group, "" if episode.scene is None else episode.info.simulated.task, *episode.cameras]
    return "-".join(re.sub(r"[^A-Za-z0-9_]+", "-", word).strip("-") for word in words if word)


def _log_ee_path(recording: rr.RecordingStream, episode: Playback) -> None:
    """Log the gripper's path, one piece per frame so that a view can show the past, coloured by phase."""
    if episode.num_frames < 2 or episode.motion.base_from_tcp is None:
        return
    points = episode.world_from_base.apply(episode.motion.base_from_tcp[:, :3])
    phases = episode.data.phases or ("",) * episode.num_frames
    colors = name_colors(phases)
    recording.log(Paths.ee_path, rr.LineStrips3D.from_fields(radii=[-2.0]), static=True)
    columns = rr.LineStrips3D.columns(
        strips=np.stack([points[:-1], points[1:]], axis=1), colors=[colors[name] for name in phases[1:]]
    )
    recording.send_columns(Paths.ee_path, indexes(episode.time_ns[1:], episode.time_ns), columns)


def _log_curves(recording: rr.RecordingStream, episode: Playback) -> None:
    for name, curves in episode.curves.items():
        entity, count = Paths.curves(name), len(curves.names)
        # Targets share a line of the legend, since it has room for eight.
        names = ["target"] * count if name == "target" else [curve.removeprefix("panda_") for curve in curves.names]
        colors = [_COLORS[name]] * count if name in _COLORS else series_colors(count)
        lines = rr.SeriesLines(names=names, colors=colors, widths=[_WIDTHS.get(name, 2.0)] * count)
        recording.log(entity, lines, static=True)
        if episode.num_frames:
            columns = rr.Scalars.columns(scalars=curves.values)
            recording.send_columns(entity, indexes(episode.time_ns, episode.time_ns), columns)


def _log_phases(recording: rr.RecordingStream, episode: Playback) -> None:
    colors = name_colors(episode.data.phases)
    if not colors or set(colors) == {""}:
        return
    recording.log(Paths.phase, rr.StateConfiguration(values=list(colors), colors=list(colors.values())), static=True)
    starts = _phase_starts(episode)
    columns = rr.StateChange.columns(state=[episode.data.phases[i] for i in starts])
    recording.send_columns(Paths.phase, indexes(episode.time_ns[starts], episode.time_ns), columns)


def _phase_starts(episode: Playback) -> list[int]:
    return [i for i, name in enumerate(episode.data.phases) if i == 0 or name != episode.data.phases[i - 1]]


def _log_events(recording: rr.RecordingStream, episode: Playback) -> None:
    colors = name_colors(episode.data.phases)
    rows: list[tuple[int, str, str, Color]] = [
        (int(episode.time_ns[i]), "INFO", episode.data.phases[i], colors[episode.data.phases[i]])
        for i in _phase_starts(episode)
        if episode.data.phases[i]
    ]
    rows += [
        (time, _LEVELS[event.level], event.message or event.name, _LEVEL_COLORS[event.level])
        for time, event in episode.data.events()
    ]
    if episode.data.outcome is not None and episode.num_frames:
        end = int(episode.time_ns[-1])
        level, color = ("INFO", (60, 230, 120)) if episode.data.outcome.success else ("ERROR", (255, 80, 80))
        rows.append((end, level, episode.verdict, color))
    if not rows:
        return
    rows.sort(key=lambda row: row[0])
    columns = rr.TextLog.columns(
        text=[row[2] for row in rows], level=[row[1] for row in rows], color=[row[3] for row in rows]
    )
    recording.send_columns(Paths.events, indexes(np.array([row[0] for row in rows]), episode.time_ns), columns)


def _log_words(recording: rr.RecordingStream, episode: Playback) -> None:
    """Log the page of current statements, rewritten at each change."""
    holds: dict[str, str] = {}
    frames, pages = [], []
    shown = sorted((item for item in episode.statements if item[1] in _HEADINGS), key=lambda item: item[0])
    for frame, group in groupby(shown, key=lambda item: item[0]):
        holds |= {kind: text for _, kind, text in group}
        frames.append(frame)
        pages.append("\n\n".join(f"**{title}**\n\n{holds[kind]}" for kind, title in _HEADINGS.items() if kind in holds))
    if pages:
        columns = rr.TextDocument.columns(text=pages, media_type=["text/markdown"] * len(pages))
        recording.send_columns(Paths.words, indexes(episode.time_ns[frames], episode.time_ns), columns)


_OF_A_RUN = re.compile(r"episode_0*(?P<number>\d+)(?:\.attempt_(?P<attempt>\d+))?")


def _entry(episode: Playback) -> str:
    """A few characters for the viewer's narrow list: "3 ok", "0.1 FAIL place" (the attempt after the dot)."""
    match, outcome = _OF_A_RUN.fullmatch(episode.name), episode.data.outcome
    name = episode.name if match is None else ".".join(part for part in match.groups() if part is not None)
    if outcome is None or outcome.success is None:
        return f"{name} ?"
    return f"{name} ok" if outcome.success else f"{name} FAIL {outcome.failure_phase}".rstrip()


def _origin(episode: Playback) -> str:
    """Describe the origin; "" for a generated episode."""
    origin = episode.info.origin
    return origin if isinstance(origin, str) else ", ".join([origin.kind, *(file.name for file in origin.files)])


def _summary(episode: Playback) -> str:
    """Write Markdown: task, length, outcome and origin."""
    info, facts = episode.info, simulation_facts(episode.info)
    about = [facts.get("task", info.robot_name), f"episode {info.episode_index}"]
    about += [f"seed {facts['root_seed']}"] if facts else []
    length = f"{episode.duration:.1f} s · {episode.num_frames} frames (nominal {info.fps} Hz)"
    parts = [f"**{info.instruction}**", " · ".join(about), length, f"Outcome: **{episode.verdict}**"]
    if origin := _origin(episode):
        parts.append(f"Origin: {origin}")
    return "\n\n".join(parts) + "\n"


def save(source: PlaybackSource, target: Path) -> None:
    """Write an episode and its layout to an .rrd file.

    The episode is collected in memory and written here: when the disk is full, Rerun's own file thread only logs the
    error, or blocks forever.

    Raises:
        DemorecError: The episode cannot be read.
        OSError: The file cannot be written.
    """
    with source.open() as episode:
        recording = new_recording(episode)
        stream = recording.binary_stream()
        recording.send_blueprint(episode_layout(episode), make_active=False, make_default=True)
        try:
            log_episode(recording, episode)
        finally:
            data = stream.read()  # in any case: Rerun warns on the terminal about unread data
            recording.disconnect()
    assert data is not None  # at least the layout
    target.write_bytes(data)


def save_each(sources: Sequence[PlaybackSource], folder: Path) -> list[Path]:
    """Write each episode to a separate .rrd file.

    Raises:
        DemorecError: An episode cannot be read, or a file cannot be written.
    """
    files = [folder / f"{index:06d}.rrd" for index in range(len(sources))]
    for source, file in zip(sources, files, strict=True):
        try:
            save(source, file)
        except OSError as error:
            raise write_error("The file", error, file, RecordingError) from error
    return files
