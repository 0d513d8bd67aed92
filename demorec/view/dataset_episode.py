"""What a dataset holds of one episode: rows, coded pictures, what is said of it, and its line of demorec's tables."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.core.geometry import Array
from demorec.datasets.lerobot.boxes import BOXES_DIR, read_boxes
from demorec.datasets.lerobot.files import read_table
from demorec.datasets.lerobot.language import COLUMNS, spoken_episodes
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.datasets.lerobot.packets import PACKET_CODECS, episode_distances, episode_packets
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.reader import episode_places
from demorec.datasets.lerobot.robots import DatasetRobot, read_robot, recognised_robot
from demorec.episode.episode import frame_time_ns
from demorec.episode.features import IMAGE_PREFIX, STATE
from demorec.view.episode import Box, Depth, Statements, Video, timed


def dataset_rows(
    root: Path, table: str, columns: list[str] | None, episode_index: int | None = None
) -> list[dict[str, Any]]:
    """Rows of a table, of one episode or of all; RecordingError when there is no such table."""
    files = sorted((root / table).glob("*/*.parquet"))
    if not files:
        raise RecordingError(f"The dataset has no {table}: {root}")
    rows = [row for file in files for row in read_table(file, columns).to_pylist()]
    return [row for row in rows if episode_index is None or row.get("episode_index") == episode_index]


class DatasetEpisode:
    """One episode of a dataset; all but `row` is read when it is asked for.

    Attributes:
        root: The dataset's folder.
        number: Of the episode.
        row: Of it, in the sidecar; empty where none is, as in anybody else's dataset.
        described: info.json.

    Raises:
        RecordingError, ExportError, ValueError, KeyError, TypeError: There is none, or its tables hold something odd.
    """

    def __init__(self, root: Path, number: int) -> None:
        self.root, self.number = root, number
        has_sidecar = (root / SIDECAR_DIR / "episodes").is_dir()
        rows = dataset_rows(root, f"{SIDECAR_DIR}/episodes", None, number) if has_sidecar else []
        self.row: dict[str, Any] = rows[0] if rows else {}
        self.described = DatasetInfo.load(root)
        places = [place for place in episode_places(root, self.described) if place.episode_index == number]
        if not places:
            raise RecordingError(f"The dataset has no episode {number}: {root}")
        self._place = places[0]

    @cached_property
    def data(self) -> dict[str, Array]:
        """Numeric feature -> (T, D)."""
        columns = [name for name, feature in self.described.features.items() if feature.is_numeric]
        rows = dataset_rows(self.root, "data", columns, self.number)
        if len(rows) != self._place.length:
            raise RecordingError(
                f"Episode {self.number} of the dataset has {len(rows)} rows, its table of episodes says "
                f"{self._place.length}: {self.root}"
            )
        result = {}
        for name in columns:
            try:
                values = np.array([row[name] for row in rows], dtype=np.float64)
            except (ValueError, TypeError, OverflowError) as error:
                raise RecordingError(f"The column {name} holds something else than numbers: {self.root}") from error
            result[name] = values if values.ndim == 2 else values[:, None]
        return result

    @cached_property
    def time_ns(self) -> NDArray[np.int64]:
        """(T,) of the rows, since the first one."""
        fps = int(self.described.fps)
        return np.array([frame_time_ns(index, fps) for index in range(self._place.length)], dtype=np.int64)

    @cached_property
    def robot(self) -> DatasetRobot | None:
        """The arm that the sidecar keeps, or one of ours that has joints of these names; None for neither."""
        if (name := self.row.get("robot_digest")) is not None:
            return read_robot(self.root, str(name))
        names = self.described.features[STATE].names if STATE in self.described.features else None
        return recognised_robot(names) if names and not self.row else None

    def videos(self) -> dict[str, Video]:
        """Camera -> its coded pictures."""
        result = {}
        for key, feature in self.described.features.items():
            codec = PACKET_CODECS.get(str((feature.info or {}).get("video.codec")))
            if feature.is_video and codec is not None and not feature.is_depth:
                result[key.removeprefix(IMAGE_PREFIX)] = Video(codec=codec, packets=partial(self._packets, key))
        return result

    def _packets(self, key: str) -> Iterator[tuple[int, bytes, bool]]:
        for packet in episode_packets(self.root, self.described, key, self._place):
            # Those before the episode are decoded with its first frame.
            yield int(self.time_ns[max(packet.frame, 0)]), packet.data, packet.is_keyframe

    def depth(self) -> dict[str, Depth]:
        """Depth feature, without its prefix -> reads (time_ns, (H, W) metres) of every frame."""
        result: dict[str, Depth] = {}
        for key, feature in self.described.features.items():
            if feature.is_video and feature.is_depth:
                read = partial(episode_distances, self.root, self.described, key, self._place)
                result[key.removeprefix(IMAGE_PREFIX)] = partial(timed, self.time_ns, read)
        return result

    def statements(self) -> Statements:
        """(time_ns, style, sentence) of what the language columns say."""
        if not set(COLUMNS) <= self.described.features.keys():
            return ()
        (episode,) = islice(spoken_episodes(self.root), self.number, self.number + 1)
        last, fps = len(self.time_ns) - 1, self.described.fps
        return tuple(
            (int(self.time_ns[min(round(row["timestamp"] * fps), last)]), str(row["style"]), str(row["content"]))
            for row in episode.persistent
        )

    def boxes(self) -> dict[str, dict[int, list[tuple[str, Box]]]]:
        """Camera -> frame -> what it sees, of a dataset with boxes beside it."""
        frame_of = {int(value): frame for frame, value in enumerate(self.data["index"][:, 0].tolist())}
        found: dict[str, dict[int, list[tuple[str, Box]]]] = {}
        for key in self.described.video_keys:
            path = self.root / BOXES_DIR / f"{key}.json"
            if not path.exists():
                continue
            seen = found.setdefault(key.removeprefix(IMAGE_PREFIX), {})
            for item in read_boxes(path):
                if item.index in frame_of:
                    seen.setdefault(frame_of[item.index], []).append((item.object, item.box))
        return found
