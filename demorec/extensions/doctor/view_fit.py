"""Prediction of thumbnails from the state, by ridge regression on the other episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import EpisodeEvidence, Evidence
from demorec.extensions.doctor.robust import finest
from demorec.extensions.doctor.thumbnails import CameraThumbnails, EpisodeThumbnails
from demorec.extensions.doctor.units import other_units

MIN_EPISODES = 5
"""Minimum number of episodes: each is predicted from the others."""
MIN_FRAMES = 20
MAX_LAG_S = 1.0
MAX_UNRELATED_RATIO = 0.25
"""Maximum explained variance, relative to the usual one, at which the states of other episodes are tried."""
MAX_COMPARED = 5
"""Maximum number of suspicious episodes, and of usual ones, that are compared with all others."""
_COMPONENTS = 8
_MAX_PAIRED = 8
"""Maximum number of state elements for which products of two are features too."""
_RIDGE = 1e-2


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewFit:
    """Prediction of a camera's images from the state in one episode.

    Attributes:
        lags: (L,) delays of the images after the state, frames.
        explained: (L,) ratio of the images' variance explained by the state at each lag.
        by_another: Maximum ratio explained by another episode's state; None if not computed.
    """

    lags: NDArray[np.intp]
    explained: Array
    by_another: float | None = None

    @property
    def best(self) -> float:
        """Explained ratio at the best lag."""
        return float(self.explained.max())

    @property
    def lag(self) -> float:
        """Lag with the largest explained ratio."""
        return finest(self.lags.tolist(), -self.explained)


def view_fits(evidence: Evidence) -> Mapping[str, Mapping[int, ViewFit]]:
    """Fit camera -> episode -> prediction of its images from the state, by the other episodes."""
    return {camera: _fits(evidence, images) for camera, images in evidence.cameras.items()}


def _fits(evidence: Evidence, images: CameraThumbnails) -> Mapping[int, ViewFit]:
    known = _known(evidence, images)
    known = {number: both for number, both in known.items() if len(both[1].frames) >= MIN_FRAMES}
    if len(known) < MIN_EPISODES:
        return {}
    states = _scaled(evidence, {number: episode for number, (episode, _) in known.items()})
    outputs = _outputs({number: images for number, (_, images) in known.items()})
    weights = _weights(states, outputs)
    reach = max(3, round(MAX_LAG_S * evidence.fps))

    def fit(shown: int, stated: int) -> ViewFit:
        """Predict the images of one episode from the state of another, by a fit on the episodes except the first."""
        others = [state for number, state in states.items() if number != shown]
        predicted = _features(_within(states[stated], others)) @ weights[shown]
        length = min(len(predicted), len(outputs[shown]))
        own_reach = min(reach, length // 4)
        lags = np.arange(-own_reach, own_reach + 1)
        return ViewFit(lags=lags, explained=_explained(predicted[:length], outputs[shown][:length], lags))

    found = {number: fit(number, number) for number in states}
    for number in [*_unexplained(found), *_references(found)]:
        by_another = max(fit(number, other).best for other in states if other != number)
        found[number] = replace(found[number], by_another=by_another)
    return found


def _unexplained(fits: Mapping[int, ViewFit]) -> list[int]:
    """Select a few episodes with the least explained images, less than usual."""
    limit = MAX_UNRELATED_RATIO * float(np.median([fit.best for fit in fits.values()]))
    found = [number for number, fit in fits.items() if fit.best < limit]
    return sorted(found, key=lambda number: fits[number].best)[:MAX_COMPARED]


def _references(fits: Mapping[int, ViewFit]) -> list[int]:
    """Select a few episodes whose own state explains the images as usual, spread over the set."""
    usual = float(np.median([fit.best for fit in fits.values()]))
    found = sorted(number for number, fit in fits.items() if fit.best >= MAX_UNRELATED_RATIO * usual)
    return found[:: max(1, len(found) // MAX_COMPARED)][:MAX_COMPARED]


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


def _scaled(evidence: Evidence, episodes: Mapping[int, EpisodeEvidence]) -> dict[int, Array]:
    """Compute episode -> (T, E) moving elements of the state in units of their range."""
    states = {number: episode.state for number, episode in episodes.items() if episode.state is not None}
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


def _known(evidence: Evidence, camera: CameraThumbnails) -> Mapping[int, tuple[EpisodeEvidence, EpisodeThumbnails]]:
    """Select the episodes that have both numbers and images of every frame."""
    return {
        number: (episode, images)
        for number, images in camera.episodes.items()
        if (episode := evidence.by_number.get(number)) is not None
        and episode.state is not None
        and number not in evidence.once(other_units)
        and len(images.frames) == len(episode.state)
    }
