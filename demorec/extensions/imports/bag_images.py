"""Images of a bag's episodes, read in one pass through the bag."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from heapq import merge
from itertools import repeat
from pathlib import Path

import numpy as np

from demorec.core.config import VideoConfig
from demorec.episode.episode import Outcome
from demorec.episode.info import DEPTH_UNITS
from demorec.extensions.imports.bag import Bag
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.decoding import BagDecoder
from demorec.extensions.imports.episode_writer import Image, write_episode
from demorec.extensions.imports.fields import FieldError, image_bytes
from demorec.extensions.imports.image_messages import decode_image
from demorec.extensions.imports.import_file import BagReport
from demorec.extensions.imports.planning import PlannedBag
from demorec.extensions.imports.rows import EpisodeRows
from demorec.mcap.cdr import Values
from demorec.runs.external import external_line
from demorec.runs.run_file import Attempt

_Taker = tuple[int, int, str, int]
"""Number of a message in its topic, the episode that takes it, its camera, and number of the image there."""


def write_bag(planned: PlannedBag, folder: Path, video: VideoConfig) -> tuple[BagReport, list[Attempt]]:
    """Write a bag's episodes to a run; return its report, and the episodes' lines of run.json.

    Raises:
        BagError: The bag has changed, or an image cannot be decoded.
        RecordingError: They cannot be written.
    """
    episodes = sorted(planned.episodes, key=lambda episode: int(episode.rows.table.time_ns[0]))
    images = _BagImages(planned.bag, [episode.rows for episode in episodes])
    paths = [
        write_episode(
            folder,
            episode.info,
            episode.rows.table,
            images.of(number),
            outcome=Outcome(success=episode.rows.window.success, num_frames=episode.rows.table.num_frames),
            video=video,
            subtasks=episode.subtasks,
        )
        for number, episode in enumerate(episodes)
    ]
    return planned.report, [external_line(path) for path in sorted(paths)]


class _BagImages:
    """Images of a bag, held until their episode is written.

    Args:
        bag: The bag.
        episodes: Its episodes in writing order.
    """

    def __init__(self, bag: Bag, episodes: Sequence[EpisodeRows]) -> None:
        self._bag, self._episodes = bag, episodes
        self._decoder = BagDecoder()
        self._waiting: list[deque[tuple[str, int, Values]]] = [deque() for _ in episodes]
        taken: dict[str, list[Iterator[_Taker]]] = {}
        for number, rows in enumerate(episodes):
            for name, camera in rows.cameras.items():
                order = np.argsort(camera.taken)
                takers = zip(camera.taken[order], repeat(number), repeat(name), order, strict=False)
                taken.setdefault(camera.topic, []).append(takers)
        self._takers = {topic: merge(*takers) for topic, takers in taken.items()}
        self._next = {topic: next(takers, None) for topic, takers in self._takers.items()}
        self._counts = dict.fromkeys(taken, 0)
        self._messages = bag.messages([], taken.keys())

    def of(self, episode: int) -> Iterator[tuple[str, Image]]:
        """Yield (camera, image) of an episode as they arrive, sorted by time for each camera.

        Raises:
            BagError: The bag has changed, or an image cannot be decoded.
        """
        cameras, waiting = self._episodes[episode].cameras, self._waiting[episode]
        early: dict[tuple[str, int], Values] = {}
        num_given = dict.fromkeys(cameras, 0)
        for _ in range(sum(len(camera.taken) for camera in cameras.values())):
            while not waiting:
                self._read_on(episode)
            name, number, values = waiting.popleft()
            early[name, number] = values
            while (found := early.pop((name, num_given[name]), None)) is not None:
                num_given[name] += 1
                is_coded = cameras[name].kept and cameras[name].kept not in DEPTH_UNITS
                try:
                    yield name, image_bytes(found) if is_coded else decode_image(found)
                except FieldError as error:
                    raise self._unusable(cameras[name].topic, error) from error

    def _read_on(self, episode: int) -> None:
        """Read one more message; hold its image for the episodes that take it."""
        message = next(self._messages, None)
        if message is None:
            missing = next(iter(self._episodes[episode].cameras.values())).topic
            raise BagError(f"The bag has changed while it was read: images of {missing} are missing.")
        topic = message.channel.topic
        number, self._counts[topic] = self._counts[topic], self._counts[topic] + 1
        values: Values | None = None
        while (taker := self._next[topic]) is not None and taker[0] == number:
            if values is None:
                try:
                    values = self._decoder.values(message)
                except ValueError as error:
                    raise self._unusable(topic, error) from error
            _, of, camera, place = taker
            self._waiting[of].append((camera, place, values))
            self._next[topic] = next(self._takers[topic], None)

    def _unusable(self, topic: str, error: ValueError) -> BagError:
        return BagError(f"An image of {topic} cannot be used, since {error}: {self._bag.path}")
