"""COCO annotations of a dataset's images, one JSON file per camera, written while episodes are added."""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from demorec.annotate import BoxEntry
from demorec.core.errors import ExportError, describe_error
from demorec.core.files import Closing, open_regular
from demorec.core.plain import parse_json
from demorec.datasets.lerobot.paths import SIDECAR_DIR

BOXES_DIR = f"{SIDECAR_DIR}/boxes"
SeenByCamera = tuple[int, int, tuple[BoxEntry, ...]]
"""Width and height of a camera's images in an episode, px, and visible objects row by row."""
Box = tuple[int, str, tuple[float, float, float, float]]
"""Frame, name of the body, (x, y, width, height) px."""


def _line(raw: bytes) -> str:
    return raw.decode().strip().rstrip(",")


@contextmanager
def _box_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ExportError(f"The boxes cannot be read ({describe_error(error)}): {path}") from error


class StoredBoxes:
    """A boxes file of demorec by episode, indexed by line in one pass; ExportError if it is missing or invalid.

    Args:
        starts: First row of each episode over the dataset.
    """

    def __init__(self, path: Path, starts: Sequence[int]) -> None:
        self._path, self._starts = path, list(starts)
        self._parts: dict[int, tuple[int, int]] = {}
        self._sizes: dict[int, tuple[int, int]] = {}
        with _box_errors(path), open_regular(path) as file:
            in_images, offset, categories = False, 0, None
            for raw in file:
                line = _line(raw)
                if line.startswith('{"id"'):
                    item = parse_json(line)
                    episode = self._episode(int(item["id" if in_images else "image_id"]))
                    if in_images:
                        self._sizes.setdefault(episode, (int(item["width"]), int(item["height"])))
                    else:
                        begin, _ = self._parts.get(episode, (offset, 0))
                        self._parts[episode] = (begin, offset + len(raw))
                elif line == "]":
                    in_images = True
                elif line.startswith('"categories"'):
                    categories = parse_json("{" + line)["categories"]
                offset += len(raw)
            if categories is None:
                raise ValueError("its end is missing")
            self._nouns = {item["id"]: str(item["name"]) for item in categories}

    def _episode(self, index: int) -> int:
        return bisect_right(self._starts, index) - 1

    def read(self, episode: int, first: int, last: int) -> SeenByCamera | None:
        """Read the boxes of frames `first` to `last` - 1; None for an episode without boxes."""
        if episode not in self._sizes:
            return None
        (width, height), start = self._sizes[episode], self._starts[episode] + first
        begin, end = self._parts.get(episode, (0, 0))
        kept = []
        with _box_errors(self._path), open_regular(self._path) as file:
            file.seek(begin)
            for raw in file.read(end - begin).splitlines():
                item = parse_json(_line(raw))
                row = int(item.pop("image_id")) - start
                noun = self._nouns[item.pop("category_id")]
                if 0 <= row < last - first:
                    del item["id"]
                    kept.append((row, noun, item))
        return width, height, tuple(kept)

    def drawn(self, episode: int, num_frames: int) -> Iterator[Box]:
        """Yield every box of an episode, frame by frame."""
        seen = self.read(episode, 0, num_frames)
        for frame, _, values in () if seen is None else seen[2]:
            with _box_errors(self._path):
                x, y, width, height = (float(number) for number in values["bbox"])
                yield frame, str(values["object"]), (x, y, width, height)


class BoxFile(Closing):
    """Context manager that writes a COCO file of the dataset at `root`, episode by episode; `finish` completes it. The
    images' descriptions follow the annotations, which arrive at the same time.
    """

    def __init__(self, root: Path, key: str, fps: int) -> None:
        path = root / BOXES_DIR / f"{key}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        self._key, self._fps = key, fps
        self._annotations: IO[str] = path.open("w")
        self._annotations.write('{"info": {"description": "boxes from the simulator"},\n"annotations": [\n')
        self._categories: dict[str, int] = {}
        self._num_annotations = 0
        self._episodes: list[tuple[int, int, int, int, int]] = []

    def add(self, episode_index: int, seen: SeenByCamera, first_index: int, num_frames: int) -> None:
        """Add the visible objects of an episode, whose first row in the dataset is `first_index`."""
        width, height, objects = seen
        self._episodes.append((episode_index, first_index, num_frames, width, height))
        for row, noun, values in objects:
            category = self._categories.setdefault(noun, len(self._categories) + 1)
            self._num_annotations += 1
            annotation = {
                "id": self._num_annotations,
                "image_id": first_index + row,
                "category_id": category,
                **values,
            }
            self._annotations.write((",\n" if self._num_annotations > 1 else "") + json.dumps(annotation))

    def finish(self) -> None:
        """Add the images and categories."""
        self._annotations.write('\n],\n"images": [\n')
        separator = ""
        for episode_index, first_index, num_frames, width, height in self._episodes:
            for row in range(num_frames):
                image = {
                    "id": first_index + row,
                    "width": width,
                    "height": height,
                    "file_name": f"{self._key}/episode_{episode_index:06d}/frame_{row:06d}.png",
                    "episode_index": episode_index,
                    "frame_index": row,
                    "timestamp": row / self._fps,
                }
                self._annotations.write(separator + json.dumps(image))
                separator = ",\n"
        categories = [{"id": number, "name": noun} for noun, number in self._categories.items()]
        self._annotations.write(f'\n],\n"categories": {json.dumps(categories)}}}\n')
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._annotations.close()
