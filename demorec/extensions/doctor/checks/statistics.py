"""Checks of a dataset's statistics, which normalise training data: of the whole dataset and of each episode."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from demorec.check.base import Fault, NotMeasuredError, Severity, check
from demorec.datasets.lerobot.layout import STATS_PATH
from demorec.datasets.lerobot.stats import NAMES
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import OLD_STATS
from demorec.extensions.datasets.statistic_errors import StatisticError, numbers_of, statistic_errors
from demorec.extensions.doctor.checks.files import folder_of
from demorec.extensions.doctor.evidence import REPAIR, Evidence

MIN_BROKEN_ERROR = 0.2
"""Minimum error of broken statistics: normalised values are wrong by a fifth of their spread."""
_COUNTED = ("index", "episode_index", "task_index", "frame_index", "timestamp")


@check(
    family="files",
    needs="a LeRobot dataset",
    measures="statistics that are missing or do not match the rows",
    unit="standard deviations",
    why="Training normalises by them: state and action are shifted and squeezed.",
    do=REPAIR,
)
def wrong_statistics(evidence: Evidence) -> Iterator[Fault]:
    """Recompute minimum, maximum, mean, deviation, count and quantiles of every column, and of each episode.

    A quantile may also be the mean of the episodes' quantiles, as LeRobot computes it, or between them, as after its
    merge. The deviation of a joint parked far from zero may have the rounding of LeRobot's float32.
    """
    folder = folder_of(evidence)
    if folder.info.is_old and not (evidence.path / OLD_STATS).exists():
        raise NotMeasuredError(f"{OLD_STATS} is missing")
    if not folder.info.is_old and not (evidence.path / STATS_PATH).exists():
        yield Fault(severity="broken", message=f"{STATS_PATH} is missing")
        return
    groups: dict[tuple[bool, Severity, int | None, str, str], list[StatisticError]] = {}
    for error in statistic_errors(folder, {each.number: each.columns for each in evidence.episodes}):
        is_missing = math.isinf(error.error)
        key = (is_missing, _severity(error), error.episode, error.quantity, error.place)
        groups.setdefault(key, []).append(error)
    for (is_missing, severity, episode, quantity, file), errors in groups.items():
        features = ", ".join(error.feature for error in errors)
        largest = max(error.error for error in errors)
        unit = "rows" if quantity == "count" else "deviations"
        yield Fault(
            severity=severity,
            episode=episode,
            value="missing" if is_missing else f"{largest:.2g} {unit}",
            message=f"the {quantity} of {features} in {file} "
            + ("is missing" if is_missing else "does not match the rows"),
        )
    if folder.info.is_old:
        return  # training aggregates the episodes' statistics
    if evidence.unreadable:
        raise NotMeasuredError(f"the whole dataset's, since {len(evidence.unreadable)} of its episodes cannot be read")
    if unknown := [name for name in folder.statistics if name not in folder.info.features]:
        yield Fault(severity="look", message=f"{STATS_PATH} has {', '.join(unknown[:3])}, which is not a feature")
    yield from _image_forms(folder)


def _severity(error: StatisticError) -> Severity:
    """Judge by the size of the error; one episode counts half in training on several."""
    size = error.error if error.episode is None else error.error / 2
    is_used = error.feature not in _COUNTED and error.quantity != "count"
    return "broken" if size > MIN_BROKEN_ERROR and is_used else "look"


def _image_forms(folder: LeRobotFolder) -> Iterator[Fault]:
    """Find statistics of cameras that are not finite numbers."""
    for name, entry in folder.statistics.items():
        if name in folder.info.features and folder.info.features[name].is_camera:
            bad = [q for q in NAMES if q in entry and not _is_finite(entry[q])]
            if bad:
                yield Fault(severity="broken", message=f"{', '.join(bad)} of {name} in {STATS_PATH} is not a number")


def _is_finite(value: Any) -> bool:
    found = numbers_of(value)
    return bool(len(found) and np.isfinite(found).all())


@check(
    family="files",
    needs="images, a LeRobot dataset of v3.0",
    measures="mean colours that do not match the images",
    unit="of 1",
    why="Images are normalised by them.",
    do="demorec dataset select {path} --where 'num_frames > 0' --decode --out NEW computes them again",
)
def wrong_colours(evidence: Evidence) -> Iterator[Fault]:
    """Compare the mean colour of each camera in meta/stats.json with that of the decoded images.

    Writers sample images, so an error of 0.08 of the full range is allowed.
    """
    folder = folder_of(evidence)
    cameras = evidence.need_images()
    if folder.info.is_old or not (evidence.path / STATS_PATH).exists():
        raise NotMeasuredError(f"{STATS_PATH} of v3.0 is missing")
    for camera, images in cameras.items():
        stored = numbers_of(folder.statistics.get(camera, {}).get("mean"))
        if not images.episodes or images.errors:
            continue
        weights = [len(each.frames) for each in images.episodes.values()]
        true = np.average([each.colour for each in images.episodes.values()], axis=0, weights=weights)
        error = float(np.abs(stored - true).max()) if stored.shape == true.shape else math.inf
        if error > 0.08:
            yield Fault(
                severity="broken",
                value=f"{error:.2f} of 1",
                message=f"the mean colour of {camera} in {STATS_PATH} is {error:.2f} off that of the images",
            )
