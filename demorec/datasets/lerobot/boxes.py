"""COCO annotations of a dataset's images, one JSON file per camera, written while episodes are added."""

from __future__ import annotations

import json
from pathlib import Path
from typing import IO

from demorec.annotate import BoxEntry
from demorec.core.files import Closing
from demorec.datasets.lerobot.paths import SIDECAR_DIR

BOXES_DIR = f"{SIDECAR_DIR}/boxes"
SeenByCamera = tuple[int, int, tuple[BoxEntry, ...]]
"""Width and height of a camera's images in an episode, px, and visible objects row by row."""


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
