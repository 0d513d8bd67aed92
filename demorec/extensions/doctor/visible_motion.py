"""Effect of each joint's motion on the images of a camera, fitted to all frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import EpisodeEvidence, Evidence
from demorec.extensions.doctor.thumbnails import CameraThumbnails, EpisodeThumbnails
from demorec.extensions.doctor.units import other_units

MIN_FRAMES = 20
"""Minimum number of frames for the fit."""
_SWEEPS = 100


@dataclass(frozen=True, kw_only=True, eq=False)
class VisibleMotion:
    """Effect of motion on the images of a camera.

    Attributes:
        weights: (D,) change of an image, of 255, for a step of each element by its usual range.
        usual_change: Change of an image while the robot moves fast, of 255.
    """

    weights: Array
    usual_change: float

    def expected(self, evidence: Evidence, episode: EpisodeEvidence, images: EpisodeThumbnails) -> Array:
        """Compute (N - 1,) change between consecutive images expected from the motion, at most the usual one."""
        return np.asarray(np.minimum(_steps(evidence, episode, images) @ self.weights, 2 * self.usual_change))


def visible_motion(evidence: Evidence, camera: CameraThumbnails) -> VisibleMotion | None:
    """Fit the change of a camera's images to the joints' steps; None if nothing moves or changes."""
    steps: list[Array] = []
    changes: list[Array] = []
    for number, images in camera.episodes.items():
        episode = evidence.by_number.get(number)
        if episode is None or episode.state is None or len(images.frames) < 2 or number in evidence.once(other_units):
            continue
        steps.append(_steps(evidence, episode, images))
        changes.append(images.change[1:].astype(np.float64))
    if not steps or sum(map(len, steps)) < MIN_FRAMES:
        return None
    x, y = np.concatenate(steps), np.concatenate(changes)
    rest = float(np.median(y[x.max(axis=1, initial=0.0) == 0])) if (x == 0).all(axis=1).any() else 0.0
    weights = _non_negative_fit(x.T @ x, x.T @ np.maximum(y - rest, 0.0))
    moving = y[x @ weights > np.median(x @ weights)]
    usual_change = float(np.quantile(moving, 0.75)) if len(moving) else 0.0
    return VisibleMotion(weights=weights, usual_change=usual_change) if usual_change > 0 else None


def _non_negative_fit(squares: Array, products: Array) -> Array:
    """Solve (D,) non-negative least squares weights by coordinate descent on the normal equations."""
    weights = np.zeros(len(products))
    for _ in range(_SWEEPS):
        for place in np.flatnonzero(np.diag(squares) > 0):
            rest = products[place] - squares[place] @ weights
            weights[place] = max(0.0, weights[place] + rest / squares[place, place])
    return weights


def _steps(evidence: Evidence, episode: EpisodeEvidence, images: EpisodeThumbnails) -> Array:
    """Compute (N - 1, D) size of each element's step between images, in units of its usual range."""
    assert episode.state is not None
    position = episode.state[np.minimum(images.frames, len(episode.state) - 1)]
    ranges = evidence.ranges
    return np.asarray(np.abs(np.diff(position, axis=0)) / np.where(ranges > 0, ranges, np.inf))
