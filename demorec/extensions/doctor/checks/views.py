"""Checks of images against the state: whether they show this motion, at this time.

Thumbnails are predicted from the state by ridge regression on the other episodes. If the state usually explains the
images, an episode with delayed or unexplained ones has images of another time or recording.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Fault, NotMeasuredError, check
from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import DROP, Evidence
from demorec.extensions.doctor.robust import finest, usual
from demorec.extensions.doctor.thumbnails import CameraThumbnails, EpisodeThumbnails
from demorec.extensions.doctor.units import other_units

MIN_EPISODES = 5
"""Minimum number of episodes: each is predicted from the others."""
MIN_FRAMES = 20
MAX_LAG_S = 1.0
_COMPONENTS = 8
_MAX_PAIRED = 8
"""Maximum number of state elements for which products of two are features too."""
_RIDGE = 1e-2
MIN_EXPLAINED = 0.35
"""Minimum ratio of the images' variance that the state usually explains, for a camera to be judged."""
MAX_SET_LAG_S = 0.3
"""Maximum usual delay of images after the state: cameras need 30 to 150 ms."""
MIN_SHIFT = 1.5
"""Minimum offset, frames, of an early or late episode's images."""
MIN_GAIN = 1.4
"""Minimum factor by which an episode's own lag reduces the unexplained variance, compared with the usual one."""


@check(
    family="images",
    needs="images, state, five episodes",
    measures="images that come early or late",
    unit="frames",
    why="The policy sees images from a different time than the action.",
    do=DROP,
)
def image_lag(evidence: Evidence) -> Iterator[Fault]:
    """Find the delay at which the images match the state best: in the set, and in each episode against the others."""
    for camera, fits in _judged(evidence):
        lags = {number: fit.lag for number, fit in fits.items()}
        usual_lag, spread = usual(list(lags.values()), floor=0.2)
        images = evidence.cameras[camera].episodes
        changed = {number: float(np.mean(images[number].change != 0)) for number in fits}
        usual_changed = float(np.median(list(changed.values())))
        if abs(usual_lag) > max(MAX_SET_LAG_S * evidence.fps, 2.0):
            yield Fault(
                severity="look",
                value=f"{evidence.seconds(usual_lag):+.2f} s",
                message=f"{camera} follows the state by {evidence.seconds(usual_lag):+.2f} s",
                do="compare the clocks of camera and robot in the recorder",
            )
        for number, fit in fits.items():
            shift = lags[number] - usual_lag
            if changed[number] < usual_changed / 2:
                continue  # another check reports images that stand still
            if abs(shift) > max(MIN_SHIFT, 6 * spread) and _gain(fit, usual_lag) > MIN_GAIN:
                yield Fault(
                    severity="broken",
                    episode=number,
                    value=f"{shift:+.1f} frames",
                    message=f"{camera} is {abs(shift):.1f} frames {'late' if shift > 0 else 'early'} in this episode",
                )


def _gain(fit: ViewFit, usual_lag: float) -> float:
    place = int(np.argmin(np.abs(fit.lags - usual_lag)))
    return float((1 - fit.explained[place]) / max(1 - fit.explained.max(), 1e-3))


def _judged(evidence: Evidence) -> Iterator[tuple[str, Mapping[int, ViewFit]]]:
    """Yield each camera with images that the state usually explains."""
    evidence.need_state(MIN_FRAMES)
    reasons = []
    for camera, images in evidence.need_images().items():
        fits = _fits(evidence, images)
        if len(fits) < MIN_EPISODES:
            reasons.append(f"{camera} has fewer than {MIN_EPISODES} episodes of {MIN_FRAMES} frames")
        elif np.median([fit.explained.max() for fit in fits.values()]) < MIN_EXPLAINED:
            reasons.append(f"{camera} shows too little of the robot")
        else:
            yield camera, fits
    if len(reasons) == len(evidence.cameras):
        raise NotMeasuredError("; ".join(reasons))


class ViewFit(NamedTuple):
    """Prediction of a camera's images from the state in one episode.

    Attributes:
        lags: (L,) delays of the images after the state, frames.
        explained: (L,) ratio of the images' variance explained by the state at each lag.
    """

    lags: NDArray[np.intp]
    explained: Array

    @property
    def lag(self) -> float:
        """Lag with the largest explained ratio."""
        return finest(self.lags.tolist(), -self.explained)


def _fits(evidence: Evidence, camera: CameraThumbnails) -> Mapping[int, ViewFit]:
    """Predict the images of each episode that has both numbers and images of every frame, by the other episodes."""
    states: dict[int, Array] = {}
    images: dict[int, EpisodeThumbnails] = {}
    for number, each in camera.episodes.items():
        episode = evidence.by_number.get(number)
        if episode is None or episode.state is None or number in evidence.once(other_units):
            continue
        if len(each.frames) == len(episode.state) >= MIN_FRAMES:
            states[number] = episode.state
            images[number] = each
    if len(states) < MIN_EPISODES:
        return {}
    scaled = _scaled(evidence, states)
    outputs = _outputs(images)
    weights = _weights(scaled, outputs)
    max_lag = max(3, round(MAX_LAG_S * evidence.fps))
    found = {}
    for number, state in scaled.items():
        predicted = _features(_within(state, [each for other, each in scaled.items() if other != number]))
        reach = min(max_lag, len(state) // 4)
        lags = np.arange(-reach, reach + 1)
        found[number] = ViewFit(lags, _explained(predicted @ weights[number], outputs[number], lags))
    return found


def _weights(states: Mapping[int, Array], outputs: Mapping[int, Array]) -> dict[int, Array]:
    """Compute episode -> (F, 8) weights that predict images from features, fitted to all other episodes."""
    inputs = {number: _features(state) for number, state in states.items()}
    products = {number: (x.T @ x, x.T @ outputs[number]) for number, x in inputs.items()}
    squares, crossed = (sum(pair[k] for pair in products.values()) for k in (0, 1))
    found = {}
    for number, (own_squares, own_crossed) in products.items():
        left = squares - own_squares
        ridge = _RIDGE * np.trace(left) / len(left) * np.eye(len(left))
        found[number] = np.linalg.solve(left + ridge, crossed - own_crossed)
    return found


def _scaled(evidence: Evidence, states: Mapping[int, Array]) -> dict[int, Array]:
    """Compute episode -> (T, E) moving elements of the state in units of their range."""
    alive = evidence.ranges > 0
    middle = np.median(np.stack([np.median(state, axis=0) for state in states.values()]), axis=0)[alive]
    return {n: np.clip((state[:, alive] - middle) / evidence.ranges[alive], -3, 3) for n, state in states.items()}


def _within(state: Array, others: Sequence[Array]) -> Array:
    """Clip the state (T, E) to the range of the others: a fit of squares and products does not extrapolate."""
    lowest = np.min([other.min(axis=0) for other in others], axis=0)
    highest = np.max([other.max(axis=0) for other in others], axis=0)
    return np.clip(state, lowest, highest)


def _features(state: Array) -> Array:
    """Compute (T, F) elements, their squares and products."""
    parts = [np.ones((len(state), 1)), state, state**2]
    if state.shape[1] <= _MAX_PAIRED:
        first, second = np.triu_indices(state.shape[1], 1)
        parts.append(state[:, first] * state[:, second])
    return np.hstack(parts)


def _outputs(images: Mapping[int, EpisodeThumbnails]) -> dict[int, Array]:
    """Compute episode -> (T, 8) principal components of the thumbnails, each episode around its own mean."""
    flat = {n: each.thumbnails.reshape(len(each.thumbnails), -1).astype(np.float32) for n, each in images.items()}
    centred = {number: each - each.mean(axis=0) for number, each in flat.items()}
    covariance = sum((each.T @ each) / max(float((each**2).sum()), 1e-9) for each in centred.values())
    _, vectors = np.linalg.eigh(np.asarray(covariance, dtype=np.float64))
    return {number: each @ vectors[:, -_COMPONENTS:] for number, each in centred.items()}


def _explained(predicted: Array, shown: Array, lags: NDArray[np.intp]) -> Array:
    """Compute the (L,) ratio of the shown variance explained by the prediction at each lag."""
    reach = int(lags[-1])
    core = predicted[reach : len(predicted) - reach]
    core = core - core.mean(axis=0)
    shares = []
    for lag in lags:
        part = shown[reach + lag : len(shown) - reach + lag]
        part = part - part.mean(axis=0)
        total = float((part**2).sum())
        shares.append(1 - float(((part - core) ** 2).sum()) / total if total > 0 else 0.0)
    return np.array(shares)
