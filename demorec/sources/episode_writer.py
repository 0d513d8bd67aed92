"""An episode on its way into its recording, while its bag is read a second time for the images.

Images that are encoded already stay as they are, byte for byte; pixels are encoded once. A frame is written as soon as
its images are, so that of a bag of any size only what is under way is in memory."""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.files import Closing, read_text_limited
from demorec.episode.episode import Outcome, Sample, SampledFrame
from demorec.episode.info import DEPTH_UNITS, Camera, EpisodeInfo, Feature
from demorec.mcap import EpisodeWriter
from demorec.mcap.cdr import Values
from demorec.sources.bag import Bag
from demorec.sources.bag_files import BagError
from demorec.sources.clock import Int
from demorec.sources.fields import image_bytes
from demorec.sources.frames_writer import imported_feature
from demorec.sources.image_messages import decode_image
from demorec.sources.rows import CameraRows, EpisodeRows, FeatureRows, Timelines
from demorec.sources.streams import BagStreams

_MAX_WAITING = 1 << 29
"""Bytes of images that wait for earlier ones, which come later in the bag."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedEpisode:
    """An episode that shall be written.

    Attributes:
        info: What is known of it.
        rows: Its rows.
        subtasks: Row -> what is begun there, in words.
    """

    info: EpisodeInfo
    rows: EpisodeRows
    subtasks: Mapping[int, str]


@dataclass(kw_only=True, eq=False)
class _Waiting:
    plan: CameraRows
    first: int
    places: Int
    num_written: int = 0
    images: dict[int, tuple[bytes | Any, int]] = field(default_factory=dict)
    num_bytes: int = 0


def _places(numbers: Int, first: int) -> Int:
    """(K,) of each message of a topic, from the first taken one to the last: which taken one it is, -1 for none."""
    places: Int = np.full(int(numbers.max(initial=first - 1)) - first + 1, -1)
    places[numbers - first] = np.arange(len(numbers))
    return places


class ImportedEpisodeWriter(Closing):
    """Writes one episode; a context manager, which leaves nothing behind unless `finish` was called.

    Args:
        path: Of the recording.
        episode: The episode.
        video: How pixels are encoded.
    """

    def __init__(self, path: Path, episode: PlannedEpisode, *, video: VideoConfig) -> None:
        self._rows, self._subtasks = episode.rows, episode.subtasks
        self._waiting: dict[str, _Waiting] = {}
        for name, plan in episode.rows.cameras.items():
            first = int(plan.taken.min()) if len(plan.taken) else 0
            self._waiting[name] = _Waiting(plan=plan, first=first, places=_places(plan.taken, first))
        self._next_row = 0
        self._writer = EpisodeWriter(path, episode.info, video=video, keeps_part=False)

    def close(self) -> None:
        """Leave nothing behind unless it is finished."""
        self._writer.close()

    @property
    def is_complete(self) -> bool:
        """Whether nothing more is needed of the bag."""
        return all(waiting.num_written == len(waiting.plan.taken) for waiting in self._waiting.values())

    def add(self, topic: str, number: int, values: Values) -> None:
        """Take a message of a camera's topic, if the episode wants it.

        Raises:
            FieldError: Its image cannot be decoded.
            RecordingError: It cannot be written.
        """
        for name, waiting in self._waiting.items():
            place = number - waiting.first
            if waiting.plan.topic == topic and 0 <= place < len(waiting.places) and waiting.places[place] >= 0:
                self._take(name, waiting, int(waiting.places[place]), values)
        self._write_rows()

    def _take(self, name: str, waiting: _Waiting, place: int, values: Values) -> None:
        is_coded = waiting.plan.kept and waiting.plan.kept not in DEPTH_UNITS
        data: Any = image_bytes(values) if is_coded else decode_image(values)
        size = len(data) if isinstance(data, bytes) else data.nbytes
        waiting.images[place] = (data, size)
        waiting.num_bytes += size
        while waiting.num_written in waiting.images:
            image, size = waiting.images.pop(waiting.num_written)
            waiting.num_bytes -= size
            self._writer.image(name, int(waiting.plan.stamps_ns[waiting.num_written]), image)
            waiting.num_written += 1
        if waiting.num_bytes > _MAX_WAITING:
            raise BagError(f"The images of {waiting.plan.topic} are too far out of order to be read in bounded memory.")

    def _write_rows(self) -> None:
        while self._next_row < len(self._rows.times_ns) and all(
            int(waiting.plan.positions[self._next_row]) < waiting.num_written for waiting in self._waiting.values()
        ):
            row = self._next_row
            time_ns = int(self._rows.times_ns[row])
            samples = {
                name: Sample(stamp_ns=time_ns - int(feature.ages_ns[row]), vector=feature.values[row])
                for name, feature in self._rows.features.items()
            }
            images = {name: int(waiting.plan.positions[row]) for name, waiting in self._waiting.items()}
            subtask = self._subtasks.get(row, "")
            self._writer.write(SampledFrame(time_ns=time_ns, samples=samples, images=images, subtask=subtask))
            self._next_row += 1

    def finish(self) -> None:
        """Write what is left and give the recording its name; BagError when images have not come."""
        self._write_rows()
        if self._next_row < len(self._rows.times_ns):
            missing = [w.plan.topic for w in self._waiting.values() if w.num_written < len(w.plan.taken)]
            raise BagError(f"The bag has changed while it was read: images of {missing[0]} are missing.")
        self._writer.finish(Outcome(success=self._rows.window.success, num_frames=self._next_row))


_MAX_URDF_BYTES = 4 << 20


def urdf_text(name: str, mapping_path: Path) -> str:
    """The URDF that a mapping names a file for; "" when it names none. ConfigError when it cannot be read."""
    if not name:
        return ""
    path = mapping_path.parent / name
    try:
        return read_text_limited(path, _MAX_URDF_BYTES)
    except (OSError, ValueError) as error:  # no text, or NUL in the name
        raise ConfigError(f"The URDF cannot be read ({getattr(error, 'strerror', 'it is no text')}): {path}") from error


def urdf_in_bag(bag: Bag, streams: BagStreams, topic: str) -> str:
    """The URDF that a topic of the bag holds; BagError when it holds none."""
    text = streams.texts[topic][0].value if streams.texts[topic] else ""
    if not isinstance(text, str) or not text.strip():
        raise BagError(f"{topic} holds no robot description: {bag.path}")
    return text


def described_feature(name: str, feature: FeatureRows, lines: Timelines, joints: Container[str]) -> Feature:
    """A feature as recordings know it, given the joints of the robot's model."""
    sources = lines.mapping.features[name]
    rules = []
    for index, source in enumerate(sources):
        if source.next:
            rules.append(f"{source.next} of the next frame")
            continue
        rules.append(f"{source.topic} {source.field}, {lines.lines[name, index].rule}")
    moved = (element if element in joints else "" for element in feature.names)
    return imported_feature(name, feature.values.dtype, feature.names, feature.units, moved, "; ".join(rules))


def described_camera(name: str, plan: CameraRows, lines: Timelines) -> Camera:
    """A camera as recordings know it."""
    info = lines.streams.infos.get(name, {})
    matrix, distortion = _first(info, "k", "K"), _first(info, "d", "D")
    size = (plan.head.width, plan.head.height)
    fits = (info.get("width") or size[0], info.get("height") or size[1]) == size
    known = fits and len(matrix) == 9 and matrix[0] > 0 and bool(np.isfinite(matrix).all())
    return Camera(
        name=name,
        width=plan.head.width,
        height=plan.head.height,
        kept=plan.kept,
        intrinsics=tuple(matrix) if known else None,
        distortion=tuple(distortion) if known and len(distortion) == 5 and np.isfinite(distortion).all() else (),
        source=f"{plan.topic}, {lines.lines[name].rule}",
    )


def _first(values: Mapping[str, Any], *keys: str) -> list[float]:
    """The numbers of the first of these fields that is there."""
    found = next((values[key] for key in keys if key in values), None)
    return [float(number) for number in found.reshape(-1)] if isinstance(found, np.ndarray) and found.size <= 64 else []
