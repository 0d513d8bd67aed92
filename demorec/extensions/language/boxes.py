"""Bounding boxes of the objects in segmentation images: COCO annotations, one JSON file per camera.

Pixels are counted from 0, x to the right and y down. Boxes enclose visible pixels only, not occluded parts.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.errors import ConfigError
from demorec.datasets.episode import ExportEpisode
from demorec.datasets.lerobot.paths import BOXES_DIR
from demorec.episode.features import IMAGE_PREFIX
from demorec.extensions.language.referring import nouns_of
from demorec.mcap import Recording

BoxEntry = tuple[int, str, Mapping[str, Any]]
"""Row of a box in its episode, the kind of its object, and its other values by COCO's names.

`bbox` is (x, y, width, height) of the pixels that show the object, `area` their number, `color` a word or "".
"""
SeenByCamera = tuple[int, int, Sequence[BoxEntry]]
"""Width and height of a camera's images in an episode, px, and visible objects row by row."""


class BoxFiles:
    """Writer of the files; each is appended to while episodes are added."""

    def __init__(self, root: Path, fps: int) -> None:
        self._folder, self._fps = root / BOXES_DIR, fps
        self._files: dict[str, _BoxFile] = {}
        self._num_episodes = self._num_frames = 0

    @staticmethod
    def read(episode: ExportEpisode[Any]) -> tuple[int, dict[str, SeenByCamera]]:
        """Return the number of frames, and the visible objects of each camera with segmentation. Raises ConfigError if
        there is none.
        """
        boxes: dict[str, SeenByCamera] = {}
        taken = {camera.name for camera in episode.cameras}
        for camera in episode.info.simulated.scene.cameras:
            if camera.name in taken and episode.recording.has_segmentation(camera.name):
                entries = tuple(_seen_objects(episode.recording, camera.name))
                boxes[IMAGE_PREFIX + camera.name] = camera.width, camera.height, entries
        if not boxes:
            raise ConfigError(
                "Boxes need recordings with segmentation (generate --segmentation), leave them out: "
                f"{episode.recording.path}"
            )
        return episode.num_frames, boxes

    def add(self, found: tuple[int, Mapping[str, SeenByCamera]]) -> None:
        """Write the boxes of the next episode."""
        num_frames, boxes = found
        for key, seen in boxes.items():
            if key not in self._files:
                self._files[key] = _BoxFile(self._folder, key)
            self._files[key].add(self._num_episodes, seen, self._num_frames, num_frames)
        self._num_frames += num_frames
        self._num_episodes += 1

    def finish(self) -> None:
        """Complete the files."""
        for file in self._files.values():
            file.finish(self._fps)


def _seen_objects(recording: Recording, camera: str) -> Iterator[BoxEntry]:
    """Yield every object that a camera with segmentation sees, frame by frame."""
    bodies = {body.name: body for body in recording.info.simulated.scene.bodies}
    named = [(value, bodies[name]) for value, name in recording.segment_names().items() if name in bodies]
    objects = [(value, body) for value, body in named if body.role in ("object", "target", "distractor")]
    for frame, image in enumerate(recording.segmentation(camera)):
        for value, body in objects:
            y, x = np.nonzero(image == value)
            if not len(x):
                continue
            left, top = int(x.min()), int(y.min())
            values = {
                "bbox": [left, top, int(x.max()) - left + 1, int(y.max()) - top + 1],
                "area": len(x),
                "iscrowd": 0,
                "object": body.name,
                "color": body.color_name,
            }
            yield frame, nouns_of(body)[0], values


class _BoxFile:
    """The file of one camera. The images' descriptions follow the annotations, which arrive at the same time."""

    def __init__(self, folder: Path, key: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path, self._key = folder / f"{key}.json", key
        self._path.write_text('{"info": {"description": "boxes from the simulator"},\n"annotations": [\n')
        self._categories: dict[str, int] = {}
        self._num_annotations = 0
        self._episodes: list[tuple[int, int, int, int, int]] = []

    def add(self, episode_index: int, seen: SeenByCamera, first_index: int, num_frames: int) -> None:
        """Add the visible objects of an episode, whose first row in the dataset is `first_index`."""
        width, height, objects = seen
        self._episodes.append((episode_index, first_index, num_frames, width, height))
        with self._path.open("a") as file:
            for row, noun, values in objects:
                self._num_annotations += 1
                annotation = {
                    "id": self._num_annotations,
                    "image_id": first_index + row,
                    "category_id": self._categories.setdefault(noun, len(self._categories) + 1),
                    **values,
                }
                file.write((",\n" if self._num_annotations > 1 else "") + json.dumps(annotation))

    def finish(self, fps: int) -> None:
        """Add the images and categories."""
        categories = [{"id": number, "name": noun} for noun, number in self._categories.items()]
        with self._path.open("a") as file:
            file.write('\n],\n"images": [\n')
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
                        "timestamp": row / fps,
                    }
                    file.write(separator + json.dumps(image))
                    separator = ",\n"
            file.write(f'\n],\n"categories": {json.dumps(categories)}}}\n')
