"""What happens over time: the gripper's path, curves, phases and events."""

from __future__ import annotations

import numpy as np
import rerun as rr

from demorec.view.episode import Curves, PlayedEpisode
from demorec.view.paths import Paths, indexes
from demorec.view.style import ASKED, FORCE, MEASURED, SECOND, TARGET, Color, phase_colors, series_colors

_COLORS = {"gripper": MEASURED, "gripper target": TARGET, "force": FORCE, "target": ASKED}
_WIDTHS = {"target": 0.7, "gripper target": 1.2}


def log_ee_path(recording: rr.RecordingStream, paths: Paths, episode: PlayedEpisode) -> None:
    """The gripper's path: one piece a frame, so that a view can show what lies behind; coloured by phase."""
    if episode.num_frames < 2 or episode.base_from_tcp is None:
        return
    points = episode.world_from_base.apply(episode.base_from_tcp[:, :3])
    phases = episode.phase or ("",) * episode.num_frames
    colors = phase_colors(phases)
    recording.log(paths.ee_path, rr.LineStrips3D.from_fields(radii=[-2.0]), static=True)
    columns = rr.LineStrips3D.columns(
        strips=np.stack([points[:-1], points[1:]], axis=1), colors=[colors[name] for name in phases[1:]]
    )
    recording.send_columns(paths.ee_path, indexes(episode.time_ns[1:], episode.time_ns), columns)


def log_curves(
    recording: rr.RecordingStream,
    paths: Paths,
    episode: PlayedEpisode,
    label: str = "",
    *,
    is_second: bool = False,
) -> None:
    """All plots; `label` goes before the names of the curves, a second episode's have other colours."""
    for name, curves in episode.curves.items():
        entity = paths.curves(name)
        lines = rr.SeriesLines(
            names=_curve_names(name, curves, label, is_second=is_second),
            colors=_curve_colors(name, curves, is_second=is_second),
            widths=[0.7 if is_second and len(curves.names) > 1 else _WIDTHS.get(name, 2.0)] * len(curves.names),
        )
        recording.log(entity, lines, static=True)
        on_frame = np.isin(curves.time_ns, episode.time_ns)
        for chosen, frame_times in ((on_frame, episode.time_ns), (~on_frame, None)):
            if chosen.any():
                columns = rr.Scalars.columns(scalars=curves.values[chosen])
                recording.send_columns(entity, indexes(curves.time_ns[chosen], frame_times), columns)


def _curve_names(name: str, curves: Curves, label: str, *, is_second: bool) -> list[str]:
    """What a legend lists: curves of one name share a line, since it has room for eight."""
    short = [curve.removeprefix("panda_") for curve in curves.names]
    if name == "target":
        short = ["target"] * len(short)
    elif is_second and len(short) > 1:
        return [label.strip()] * len(short)
    return [f"{label}{curve}" for curve in short]


def _curve_colors(name: str, curves: Curves, *, is_second: bool) -> list[Color]:
    count = len(curves.names)
    if is_second:
        return [SECOND if count == 1 else ASKED] * count
    return [_COLORS[name]] * count if name in _COLORS else series_colors(count)


def log_phases(recording: rr.RecordingStream, paths: Paths, episode: PlayedEpisode) -> None:
    """The phases of the motion as states over time."""
    colors = phase_colors(episode.phase)
    if not colors or set(colors) == {""}:
        return
    recording.log(paths.phase, rr.StateConfiguration(values=list(colors), colors=list(colors.values())), static=True)
    starts = _phase_starts(episode)
    columns = rr.StateChange.columns(state=[episode.phase[i] for i in starts])
    recording.send_columns(paths.phase, indexes(episode.time_ns[starts], episode.time_ns), columns)


def _phase_starts(episode: PlayedEpisode) -> list[int]:
    """The frames at which the phase is another than before."""
    return [i for i, name in enumerate(episode.phase) if i == 0 or name != episode.phase[i - 1]]


def log_events(recording: rr.RecordingStream, paths: Paths, episode: PlayedEpisode) -> None:
    """Changes of phase and what happened, in order."""
    colors = phase_colors(episode.phase)
    rows: list[tuple[int, str, str, Color]] = [
        (int(episode.time_ns[i]), "INFO", episode.phase[i], colors[episode.phase[i]])
        for i in _phase_starts(episode)
        if episode.phase[i]
    ]
    rows += [
        (time, _LEVELS[event.level], event.message or event.name, _LEVEL_COLORS[event.level])
        for time, event in episode.events
    ]
    if episode.outcome is not None and episode.num_frames:
        end = int(episode.time_ns[-1])
        level, color = ("INFO", (60, 230, 120)) if episode.outcome.success else ("ERROR", (255, 80, 80))
        rows.append((end, level, episode.verdict, color))
    if not rows:
        return
    rows.sort(key=lambda row: row[0])
    columns = rr.TextLog.columns(
        text=[row[2] for row in rows], level=[row[1] for row in rows], color=[row[3] for row in rows]
    )
    recording.send_columns(paths.events, indexes(np.array([row[0] for row in rows]), episode.time_ns), columns)


_LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
_LEVEL_COLORS: dict[str, Color] = {"info": (200, 200, 200), "warning": (255, 200, 60), "error": (255, 80, 80)}
