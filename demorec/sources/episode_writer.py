"""A bag's episodes on their way into their recordings, while the bag is read a second time for the images.

Images that are encoded already stay as they are, byte for byte; pixels are encoded once. A frame is written as soon as
its images are, so that of a bag of any size only what is under way is in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.config import VideoConfig
from demorec.core.files import Closing
from demorec.episode.episode import Outcome, Sample, SampledFrame
from demorec.episode.info import DEPTH_UNITS
from demorec.mcap import SampledWriter
from demorec.mcap.cdr import Values
from demorec.runs.external import episode_path, external_line
from demorec.runs.run_file import Attempt
from demorec.sources.bag import Bag
from demorec.sources.bag_files import BagError
from demorec.sources.clock import Int
from demorec.sources.decoding import BagDecoder
from demorec.sources.fields import FieldError, image_bytes
from demorec.sources.image_messages import decode_image
from demorec.sources.import_file import BagReport
from demorec.sources.planning import PlannedBag, PlannedEpisode
from demorec.sources.rows import CameraRows


def write_bag(planned: PlannedBag, folder: Path, video: VideoConfig) -> tuple[BagReport, list[Attempt]]:
    """Write a bag's episodes into a run, each while the bag's images pass once more.

    Returns:
        The bag's report, and the episodes' lines of run.json.

    Raises:
        BagError: The bag has changed, or an image cannot be decoded.
        RecordingError: They cannot be written.
    """
    bag, waiting = planned.bag, sorted(planned.episodes, key=lambda episode: int(episode.rows.times_ns[0]))
    begins: dict[tuple[str, int], list[PlannedEpisode]] = {}
    for episode in waiting:
        for plan in episode.rows.cameras.values():
            begins.setdefault((plan.topic, int(plan.taken.min())), []).append(episode)
        if not episode.rows.cameras:
            with ImportedEpisodeWriter(folder, episode, video) as writer:
                writer.finish()
    begun: set[int] = set()
    under_way: list[ImportedEpisodeWriter] = []
    with ExitStack() as stack:
        for topic, number, values in _images(bag, waiting) if begins else ():
            for episode in begins.get((topic, number), ()):
                if episode.info.episode_index not in begun:  # by an image of another camera
                    begun.add(episode.info.episode_index)
                    under_way.append(stack.enter_context(ImportedEpisodeWriter(folder, episode, video)))
            for writer in under_way:
                try:
                    writer.add(topic, number, values)
                except FieldError as error:
                    raise _unusable(bag, topic, error) from error
                if writer.is_complete:
                    writer.finish()
            under_way = [writer for writer in under_way if not writer.is_complete]
        for writer in under_way:
            writer.finish()
    paths = [episode_path(folder, episode.info.episode_index) for episode in planned.episodes]
    return planned.report, [external_line(path) for path in paths]


def _images(bag: Bag, episodes: Sequence[PlannedEpisode]) -> Iterator[tuple[str, int, Values]]:
    """(topic, number, values) of the images that any episode takes."""
    taken: dict[str, list[Int]] = {}
    for episode in episodes:
        for plan in episode.rows.cameras.values():
            taken.setdefault(plan.topic, []).append(plan.taken)
    wanted = {topic: np.bincount(np.concatenate(numbers)) > 0 for topic, numbers in taken.items()}
    decoder, counts = BagDecoder(), dict.fromkeys(wanted, 0)
    for message in bag.messages([], wanted.keys()):
        topic = message.channel.topic
        number, counts[topic] = counts[topic], counts[topic] + 1
        if number < len(wanted[topic]) and wanted[topic][number]:
            try:
                values = decoder.values(message)
            except ValueError as error:
                raise _unusable(bag, topic, error) from error
            yield topic, number, values


def _unusable(bag: Bag, topic: str, error: ValueError) -> BagError:
    return BagError(f"An image of {topic} cannot be used, since {error}: {bag.path}")


class _CameraImages:
    """A camera's images: which are still to come, and what has come but waits for earlier ones.

    Attributes:
        plan: Of the camera.
        num_missing: How many of the taken ones are still to come.
        waiting: Of the taken ones -> the image.
        num_written: How many are written.
    """

    def __init__(self, plan: CameraRows) -> None:
        self.plan = plan
        self.num_missing = len(plan.taken)
        self.waiting: dict[int, Any] = {}
        self.num_written = 0
        self._first = int(plan.taken.min()) if len(plan.taken) else 0
        self._places = np.full(int(plan.taken.max(initial=self._first - 1)) - self._first + 1, -1)
        self._places[plan.taken - self._first] = np.arange(len(plan.taken))

    def place(self, number: int) -> int:
        """Which of the taken ones a message of the topic is, -1 for none."""
        number -= self._first
        return int(self._places[number]) if 0 <= number < len(self._places) else -1


class ImportedEpisodeWriter(Closing):
    """Writes one episode; a context manager, which leaves nothing behind unless `finish` was called.

    Args:
        folder: Of the run.
        episode: The episode.
        video: How pixels are encoded.
    """

    def __init__(self, folder: Path, episode: PlannedEpisode, video: VideoConfig) -> None:
        self._rows, self._subtasks, self._next_row = episode.rows, episode.subtasks, 0
        self._cameras = {name: _CameraImages(plan) for name, plan in episode.rows.cameras.items()}
        path = episode_path(folder, episode.info.episode_index)
        self._writer = SampledWriter(path, episode.info, video=video, keeps_part=False)

    def close(self) -> None:
        """Leave nothing behind unless it is finished."""
        self._writer.close()

    @property
    def is_complete(self) -> bool:
        """Whether nothing more is needed of the bag."""
        return not any(images.num_missing for images in self._cameras.values())

    def add(self, topic: str, number: int, values: Values) -> None:
        """Take a message of a camera's topic, if the episode wants it.

        Raises:
            FieldError: Its image cannot be decoded.
            RecordingError: It cannot be written.
        """
        for name, images in self._cameras.items():
            if images.plan.topic == topic and (place := images.place(number)) >= 0:
                images.num_missing -= 1
                self._take(name, images, place, values)
        self._write_rows()

    def _take(self, name: str, images: _CameraImages, place: int, values: Values) -> None:
        is_coded = images.plan.kept and images.plan.kept not in DEPTH_UNITS
        data: Any = image_bytes(values) if is_coded else decode_image(values)
        images.waiting[place] = data
        while images.num_written in images.waiting:
            image = images.waiting.pop(images.num_written)
            self._writer.image(name, int(images.plan.stamps_ns[images.num_written]), image)
            images.num_written += 1

    def _write_rows(self) -> None:
        while self._next_row < len(self._rows.times_ns) and all(
            int(images.plan.positions[self._next_row]) < images.num_written for images in self._cameras.values()
        ):
            row = self._next_row
            time_ns = int(self._rows.times_ns[row])
            samples = {
                name: Sample(stamp_ns=time_ns - int(feature.ages_ns[row]), vector=feature.values[row])
                for name, feature in self._rows.features.items()
            }
            shown = {name: int(images.plan.positions[row]) for name, images in self._cameras.items()}
            subtask = self._subtasks.get(row, "")
            self._writer.write(SampledFrame(time_ns=time_ns, samples=samples, images=shown, subtask=subtask))
            self._next_row += 1

    def finish(self) -> None:
        """Write what is left and give the recording its name; BagError when images have not come."""
        self._write_rows()
        if self._next_row < len(self._rows.times_ns):
            missing = [images.plan.topic for images in self._cameras.values() if images.num_missing]
            raise BagError(f"The bag has changed while it was read: images of {missing[0]} are missing.")
        self._writer.finish(Outcome(success=self._rows.window.success, num_frames=self._next_row))
