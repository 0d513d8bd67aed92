"""An episode whose frames are evenly spaced and come one after the other, as those of datasets do."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from demorec.config import VideoConfig
from demorec.recording import CollectedWriter
from demorec.scene.collected import CollectedFrame, CollectedInfo, CollectedOutcome, Sample, Vector
from demorec.scene.episode import frame_time_ns

Picture = bytes | NDArray[Any]
"""A packet that stays as it is, (H, W, 3) uint8 RGB, or (H, W) distances as `CollectedWriter.picture` takes them."""


def write_frames(
    path: Path,
    info: CollectedInfo,
    frames: Iterable[Mapping[str, Vector]],
    pictures: Mapping[str, Iterator[Picture]],
    *,
    success: bool | None,
    video: VideoConfig,
    leads: Mapping[str, int] | None = None,
) -> None:
    """Record an episode at `info.fps`: whole, or not at all.

    Args:
        path: Of the recording.
        info: What is known of the episode.
        frames: Feature -> its vector, of each frame.
        pictures: Camera -> its pictures, one a frame, its lead in front.
        success: How it ended; None when nobody said.
        video: How pixels are coded.
        leads: Camera -> how many of its pictures come before the first frame; 0 where not given.

    Raises:
        RecordingError: A number is not finite, or the disk is full.
    """
    writer = CollectedWriter(path, info, video=video)
    leads = leads or {}
    begin = max(leads.values(), default=0)
    try:
        for name, lead in leads.items():
            for number in range(begin - lead, begin):
                writer.picture(name, frame_time_ns(number, info.fps), next(pictures[name]))
        count = 0
        for vectors in frames:
            time_ns = frame_time_ns(begin + count, info.fps)
            shown = {name: writer.picture(name, time_ns, next(images)) for name, images in pictures.items()}
            samples = {name: Sample(stamp_ns=time_ns, vector=vector) for name, vector in vectors.items()}
            writer.write(CollectedFrame(time_ns=time_ns, samples=samples, pictures=shown))
            count += 1
        writer.finish(CollectedOutcome(success=success, num_frames=count))
    except BaseException:
        writer.discard()
        raise
