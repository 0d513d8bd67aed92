"""In what two datasets differ, as a report shows it: what `demorec dataset diff` finds, with the images that differ."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.datasets.editing.compare import LEVELS, Difference, Level
from demorec.datasets.editing.diff import DatasetDiff, diff
from demorec.datasets.editing.plan import Source
from demorec.datasets.editing.statistics import renamed
from demorec.datasets.lerobot.videos import EpisodeVideo, StoredImages
from demorec.datasets.options import ProgressCallback
from demorec.report.filmstrip import Filmstrip, filmstrip

_SHOWN = 100
"""Differences of each level that a page shows one by one."""
_STRIP_BYTES = 40_000
"""Of the images of one difference."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownDifference:
    """One difference; of images with the frame that differs most.

    Attributes:
        difference: What was found.
        frame: Its number in A.
        strip: That image in A, in B, and how far each pixel is apart, white for the farthest.
    """

    difference: Difference
    frame: int = 0
    strip: Filmstrip | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Differences:
    """Between dataset A, which the report is about, and B.

    Attributes:
        paths: Of A and B.
        found: All that differs.
        levels: (level, number of its differences, the first of them), of those that have any.
    """

    paths: tuple[Path, Path]
    found: DatasetDiff
    levels: tuple[tuple[Level, int, tuple[ShownDifference, ...]], ...]


def differences(a: Path, b: Path, progress: ProgressCallback | None = None) -> Differences:
    """Compare two datasets.

    Raises:
        ExportError: One is damaged.
    """
    found = diff(a, b, progress)
    sources = (Source(a), Source(b))
    names = renamed(*sources)
    levels = []
    for level in LEVELS:
        of_level = [item for item in found.differences if item.level == level]
        if of_level:
            levels.append((level, len(of_level), tuple(_shown(sources, names, item) for item in of_level[:_SHOWN])))
    return Differences(paths=(a, b), found=found, levels=tuple(levels))


def _shown(sources: tuple[Source, Source], names: dict[str, str], item: Difference) -> ShownDifference:
    if item.level != "images" or "worst" not in item.details:
        return ShownDifference(difference=item)
    n, m = item.episodes or (None, None)
    assert n is not None
    assert m is not None
    frame: int = item.details["worst"][0]["frame"]
    later = item.details["first_frame_b"] - item.details["first_frame"]
    one = _image(sources[0], item.name, n, frame)
    other = _image(sources[1], names.get(item.name, item.name), m, frame + later)
    apart = np.abs(one.astype(np.int32) - other)
    apart, largest = (apart, max(one.max(), other.max())) if one.ndim == 2 else (apart.max(axis=2), 255)
    images = _visible(one, largest), _visible(other, largest), _visible(apart, apart.max())
    strip = filmstrip(item.name, len(images), lambda _: images, max_bytes=_STRIP_BYTES, height=240)
    return ShownDifference(difference=item, frame=frame, strip=strip)


def _image(source: Source, name: str, number: int, frame: int) -> NDArray[Any]:
    """Of a frame of an episode (H, W, 3) uint8 RGB, or (H, W) codes of depth."""
    place, feature = source.places[number], source.info.features[name]
    if not feature.is_video:
        return next(StoredImages(source.info, name).read(place, [frame]))
    video = EpisodeVideo(source.info, name, place)
    return next(video.codes(frame) if feature.is_depth else video.images(frame))


def _visible(values: NDArray[Any], largest: int) -> NDArray[np.uint8]:
    """(H, W, 3), the largest value white."""
    scaled = (values * (255 / largest)).astype(np.uint8)
    return scaled if scaled.ndim == 3 else np.repeat(scaled[:, :, None], 3, axis=2)
