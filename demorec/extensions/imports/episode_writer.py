"""Atomic recording of imported episodes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.episode.episode import Outcome, Sample, SampledFrame, Table
from demorec.episode.info import EpisodeInfo
from demorec.extensions.recorder.external_run import ExternalFolder, episode_path
from demorec.extensions.recorder.sampled_writer import SampledWriter

Image = bytes | NDArray[Any]
"""A passthrough packet, (H, W, 3) uint8 RGB, or (H, W) depth in the form for `SampledWriter.image`."""


@dataclass(frozen=True, kw_only=True)
class FramesImport:
    """Result of an import of episodes with evenly spaced frames, such as from datasets.

    Attributes:
        num_episodes, num_frames: Size of the run.
        num_new: Episodes written now; the others existed.
        cameras: Camera -> treatment of its images, in words.
        left_out: Name in the source -> reason why it is not in the run; "" if the mapping does not name it.
        skipped: Episode that cannot be read -> reason.
        notes: Sentences about the reading of the source.
    """

    num_episodes: int
    num_frames: int
    num_new: int
    cameras: Mapping[str, str]
    left_out: Mapping[str, str]
    skipped: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def left_out_lines(self) -> Iterator[str]:
        """Describe notes and the data left out of the run."""
        yield from self.notes
        yield from (f"{name} is left out: {reason}." for name, reason in self.left_out.items() if reason)
        if unnamed := [name for name, reason in self.left_out.items() if not reason]:
            yield f"Left out, because the mapping does not name them: {', '.join(unnamed)}."


def add_episode(
    folder: ExternalFolder,
    info: EpisodeInfo,
    table: Table,
    images: Mapping[str, Iterator[Image]],
    *,
    outcome: Outcome,
    video: VideoConfig,
    subtasks: Mapping[int, str],
) -> None:
    """Record an episode with an image in each frame for every camera; see `write_episode`.

    Raises:
        ConfigError: The run's episodes differ from this one.
        RecordingError: A number is not finite, or the disk is full.
    """

    def frame_by_frame() -> Iterator[tuple[str, Image]]:
        for camera, stream in images.items():  # images before the first frame
            yield from ((camera, image) for image in islice(stream, int(table.images[camera][0])))
        for _ in range(table.num_frames):
            for camera, stream in images.items():
                yield camera, next(stream)

    folder.check_fits(info)
    folder.begin(info)
    folder.add(
        write_episode(folder.path, info, table, frame_by_frame(), outcome=outcome, video=video, subtasks=subtasks)
    )


def write_episode(
    folder: Path,
    info: EpisodeInfo,
    table: Table,
    images: Iterable[tuple[str, Image]],
    *,
    outcome: Outcome,
    video: VideoConfig,
    subtasks: Mapping[int, str],
) -> Path:
    """Record an episode of a run and return its file.

    Args:
        folder: The run.
        info: Description of the episode.
        table: Its numbers, and the image that each frame shows.
        images: (camera, image), in order for each camera; a frame is written when all its images are there.
        outcome: Outcome; the number of frames is set here.
        video: Encoding of pixels.
        subtasks: Frame -> subtask that begins there.

    Raises:
        RecordingError: A number is not finite, or the disk is full.
    """
    with SampledWriter(episode_path(folder, info.episode_index), info, video=video, keeps_part=False) as writer:
        remaining = iter(images)
        num_images = dict.fromkeys(table.images, 0)
        for row in range(table.num_frames):
            shown = {camera: int(numbers[row]) for camera, numbers in table.images.items()}
            while any(number >= num_images[camera] for camera, number in shown.items()):
                camera, image = next(remaining)
                writer.image(camera, int(table.image_stamps[camera][num_images[camera]]), image)
                num_images[camera] += 1
            samples = {
                name: Sample(stamp_ns=int(table.stamps[name][row]), vector=vectors[row])
                for name, vectors in table.features.items()
            }
            time_ns = int(table.time_ns[row])
            writer.write(SampledFrame(time_ns=time_ns, samples=samples, images=shown, subtask=subtasks.get(row, "")))
        return writer.finish(replace(outcome, num_frames=table.num_frames))
