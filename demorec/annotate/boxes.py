"""Bounding boxes of the objects in segmentation images.

Pixels are counted from 0, x to the right and y down. Boxes enclose visible pixels only, not occluded parts.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from demorec.annotate import BoxEntry
from demorec.episode.words import nouns_of
from demorec.mcap import Recording


def seen_objects(recording: Recording, camera: str) -> Iterator[BoxEntry]:
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
