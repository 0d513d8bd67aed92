"""Recording of a bag's episode, with the images from a second pass through the bag."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

from demorec.episode.episode import Outcome
from demorec.episode.info import DEPTH_UNITS
from demorec.extensions.imports.bag import Bag
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.decoding import decode_message
from demorec.extensions.imports.episode_writer import Image, write_episode
from demorec.extensions.imports.fields import image_bytes
from demorec.extensions.imports.image_messages import decode_image
from demorec.extensions.imports.planning import ImportSettings, PlannedBag
from demorec.extensions.imports.rows import EpisodeRows
from demorec.extensions.recorder.external_run import external_line
from demorec.mcap.cdr import Values
from demorec.runs.run_file import Attempt


def write_bag(planned: PlannedBag, folder: Path, settings: ImportSettings) -> list[Attempt]:
    """Write a bag's episode to a run; return its line of run.json.

    Raises:
        BagError: The bag has changed, or an image cannot be decoded.
        RecordingError: It cannot be written.
    """
    table = planned.rows.table
    path = write_episode(
        folder,
        planned.info,
        table,
        _images(planned.bag, planned.rows),
        outcome=Outcome(num_frames=table.num_frames),
        video=settings.video,
        subtasks={},
    )
    return [external_line(path)]


def _images(bag: Bag, rows: EpisodeRows) -> Iterator[tuple[str, Image]]:
    """Yield (camera, image) in the order of their times; images that come early are held.

    Raises:
        BagError: The bag has changed, or an image cannot be decoded.
    """
    wanted: defaultdict[tuple[str, int], list[tuple[str, int]]] = defaultdict(list)
    for name, camera in rows.cameras.items():
        for place, message in enumerate(camera.taken.tolist()):
            wanted[camera.topic, message].append((name, place))
    times = {name: stamps.tolist() for name, stamps in rows.table.image_stamps.items()}
    order = sorted((time, name, place) for name, stamps in times.items() for place, time in enumerate(stamps))
    messages = bag.messages([], {topic for topic, _ in wanted})
    counts: Counter[str] = Counter()
    held: dict[tuple[str, int], Values] = {}
    for _, name, place in order:
        camera = rows.cameras[name]
        try:
            while (name, place) not in held:
                message = next(messages, None)
                if message is None:
                    raise BagError(f"The bag has changed while it was read: images of {camera.topic} are missing.")
                topic = message.channel.topic
                if places := wanted.pop((topic, counts[topic]), ()):
                    held |= dict.fromkeys(places, decode_message(message))
                counts[topic] += 1
            values = held.pop((name, place))
            is_coded = camera.kept and camera.kept not in DEPTH_UNITS
            yield name, image_bytes(values) if is_coded else decode_image(values)
        except ValueError as error:
            raise BagError(f"An image of {camera.topic} cannot be used, since {error}: {bag.path}") from error
