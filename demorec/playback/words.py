"""What a dataset says of an episode: subtask, plan and memory on a page that changes, boxes over the pictures."""

from __future__ import annotations

from itertools import groupby

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from demorec.playback.episode import PlayedEpisode, Statements
from demorec.playback.paths import Paths
from demorec.playback.style import segment_colors
from demorec.playback.times import indexes

_HEADINGS = {"subtask": "Now", "motion": "Motion", "plan": "Plan", "memory": "So far"}
"""Kind of statement -> its heading, in the order of the page."""


def log_words(
    recording: rr.RecordingStream, paths: Paths, statements: Statements, frames_ns: NDArray[np.int64]
) -> None:
    """The page of what holds, anew whenever something changes; `frames_ns` (T,) are the times of all frames."""
    holds: dict[str, str] = {}
    times, pages = [], []
    told = sorted((item for item in statements if item[1] in _HEADINGS), key=lambda item: item[0])
    for time_ns, group in groupby(told, key=lambda item: item[0]):
        holds |= {kind: text for _, kind, text in group}
        times.append(time_ns)
        pages.append("\n\n".join(f"**{title}**\n\n{holds[kind]}" for kind, title in _HEADINGS.items() if kind in holds))
    if pages:
        columns = rr.TextDocument.columns(text=pages, media_type=["text/markdown"] * len(pages))
        recording.send_columns(paths.words, indexes(np.array(times, dtype=np.int64), frames_ns), columns)


def log_boxes(recording: rr.RecordingStream, paths: Paths, episode: PlayedEpisode) -> None:
    """Boxes around what each camera sees, frame by frame; their names, which would hide small pictures, on pointing."""
    names = sorted({name for frames in episode.boxes.values() for seen in frames.values() for name, _ in seen})
    colors = segment_colors(names)
    for camera, frames in episode.boxes.items():
        seen = [frames.get(frame, ()) for frame in range(episode.num_frames)]
        flat = [item for items in seen for item in items]
        if not flat:
            continue
        recording.log(paths.camera(camera, "/boxes"), rr.Boxes2D.from_fields(show_labels=False), static=True)
        columns = rr.Boxes2D.columns(
            half_sizes=[(width / 2, height / 2) for _, (_, _, width, height) in flat],
            centers=[(x + width / 2, y + height / 2) for _, (x, y, width, height) in flat],
            labels=[name for name, _ in flat],
            colors=[colors[name] for name, _ in flat],
        )
        lengths = [len(items) for items in seen]
        recording.send_columns(
            paths.camera(camera, "/boxes"), indexes(episode.time_ns, episode.time_ns), columns.partition(lengths)
        )
