"""What the writers of all recordings share: the file in the making, and how it is completed."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from demorec.core.errors import RecordingError
from demorec.core.files import Closing
from demorec.episode.episode import Outcome
from demorec.episode.info import EpisodeInfo
from demorec.mcap.metadata import OUTCOME, outcome_metadata, record_of
from demorec.mcap.part_file import PartFile
from demorec.mcap.pictures import PictureCoder
from demorec.mcap.recover import can_be_made_again


@dataclass(frozen=True, kw_only=True)
class WriteStats:
    """What was written.

    Attributes:
        path: The finished file.
        num_frames: Frames in it.
        num_bytes: Its size.
        video_bytes: camera -> bytes of its encoded colour images.
    """

    path: Path
    num_frames: int
    num_bytes: int
    video_bytes: Mapping[str, int]


class FileWriter[C: PictureCoder](Closing):
    """Writes one episode; leaving its block without `finish` leaves NAME.mcap.part for `recover`.

    Args:
        path: The file to be made.
        info: Of the episode: an unfinished file of the same origin is replaced.
        overwrite: Whether a recording of that name may be replaced.

    Attributes:
        num_frames: So far.
    """

    _cameras: Mapping[str, C]

    def __init__(self, path: Path, info: EpisodeInfo, *, overwrite: bool) -> None:
        self.num_frames = 0
        self._record = record_of(info)
        self._file = PartFile(path, overwrite=overwrite, is_worthless=partial(can_be_made_again, origin=info.origin))

    def close(self) -> None:
        """End it and leave NAME.mcap.part as it is; harmless when called twice, and after `finish`."""
        self._file.close()

    def finish(self, outcome: Outcome) -> WriteStats:
        """Write the rest, make the file durable and give it its name.

        Raises:
            ConfigError: A file of that name has appeared meanwhile.
            RecordingError: The outcome speaks of another number of frames, or the disk is full.
        """
        if outcome.num_frames != self.num_frames:
            raise RecordingError(f"The outcome has {outcome.num_frames} frames, the recording {self.num_frames}.")
        for camera in self._cameras.values():
            camera.end()
        self._write_rest()
        for camera in self._cameras.values():
            if (statistics := camera.statistics()) is not None:
                self._file.log(*statistics, camera.last_ns)
        self._file.metadata(OUTCOME, outcome_metadata(self._record, outcome))
        self._file.publish()
        return WriteStats(
            path=self._file.path,
            num_frames=self.num_frames,
            num_bytes=self._file.path.stat().st_size,
            video_bytes={name: camera.num_video_bytes for name, camera in self._cameras.items()},
        )

    @abstractmethod
    def _write_rest(self) -> None:
        """Write what has not been written yet; RecordingError when an encoder keeps images to itself."""
