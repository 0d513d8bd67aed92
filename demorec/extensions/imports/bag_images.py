"""Recordings of a bag's episodes, with the images from a second pass through the bag."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

from demorec.episode.episode import Outcome
from demorec.episode.info import DEPTH_UNITS
from demorec.extensions.imports.bag import Bag
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.decoding import BagDecoder
from demorec.extensions.imports.episode_writer import Image, write_episode
from demorec.extensions.imports.fields import image_bytes
from demorec.extensions.imports.image_messages import decode_image
from demorec.extensions.imports.planning import ImportSettings, PlannedBag, PlannedEpisode
from demorec.extensions.imports.rows import EpisodeRows
from demorec.mcap.cdr import Values
from demorec.runs.external import external_line
from demorec.runs.run_file import Attempt

_Place = tuple[int, str, int]
"""Number of an episode, its camera, and number of the image there."""


def write_bag(
    planned: PlannedBag, episodes: Sequence[PlannedEpisode], folder: Path, settings: ImportSettings
) -> list[Attempt]:
    """Write some of a bag's episodes to a run; return their lines of run.json.

    Raises:
        BagError: The bag has changed, or an image cannot be decoded.
        RecordingError: They cannot be written.
    """
    episodes = sorted(episodes, key=lambda episode: int(episode.rows.table.time_ns[0]))
    images = _BagImages(planned.bag, [episode.rows for episode in episodes])
    paths = [
        write_episode(
            folder,
            episode.info,
            episode.rows.table,
            images.of(number),
            outcome=Outcome(success=episode.rows.window.success, num_frames=episode.rows.table.num_frames),
            video=settings.video,
            subtasks={},
        )
        for number, episode in enumerate(episodes)
    ]
    return [external_line(path) for path in sorted(paths)]


class _BagImages:
    """Images of a bag's episodes, given in writing order, held until their episode is written."""

    def __init__(self, bag: Bag, episodes: Sequence[EpisodeRows]) -> None:
        self._bag, self._episodes = bag, episodes
        self._decoder = BagDecoder()
        self._wanted: defaultdict[tuple[str, int], list[_Place]] = defaultdict(list)
        for number, rows in enumerate(episodes):
            for name, camera in rows.cameras.items():
                for place, message in enumerate(camera.taken.tolist()):
                    self._wanted[camera.topic, message].append((number, name, place))
        self._held: dict[_Place, Values] = {}
        self._counts: Counter[str] = Counter()
        self._messages = bag.messages([], {topic for topic, _ in self._wanted})

    def of(self, episode: int) -> Iterator[tuple[str, Image]]:
        """Yield (camera, image) of an episode in the order of their times.

        Raises:
            BagError: The bag has changed, or an image cannot be decoded.
        """
        rows = self._episodes[episode]
        times = {name: stamps.tolist() for name, stamps in rows.table.image_stamps.items()}
        for _, name, place in sorted(
            (time, name, k) for name, stamps in times.items() for k, time in enumerate(stamps)
        ):
            camera = rows.cameras[name]
            try:
                while (episode, name, place) not in self._held:
                    self._read_on(camera.topic)
                values = self._held.pop((episode, name, place))
                is_coded = camera.kept and camera.kept not in DEPTH_UNITS
                yield name, image_bytes(values) if is_coded else decode_image(values)
            except ValueError as error:
                raise BagError(f"An image of {camera.topic} cannot be used, since {error}: {self._bag.path}") from error

    def _read_on(self, missing: str) -> None:
        """Read one more message; hold its image for the episodes that take it."""
        message = next(self._messages, None)
        if message is None:
            raise BagError(f"The bag has changed while it was read: images of {missing} are missing.")
        topic = message.channel.topic
        places = self._wanted.pop((topic, self._counts[topic]), ())
        self._counts[topic] += 1
        if places:
            self._held |= dict.fromkeys(places, self._decoder.values(message))
