"""How far an episode is from others of its task: what most of them do is taken as sound."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from demorec.check.evidence import Flags
from demorec.check.scoring.sight import HUE, LIGHT
from demorec.core.geometry import Array

FEWEST = 12
"""Episodes of one instruction that are compared among themselves; fewer ones are compared with all of the dataset."""
_NORMAL = 1.4826
"""Standard deviation of a normal distribution in units of its median absolute deviation."""
_DAMPING = 1e-2
_ROWS_EACH = 3
"""Episodes for each number of a model of them, at least."""
_RIDGE, _PREDICTED, _LEAST_ERROR = 0.3, 0.75, 0.25
"""Of the model of words: its damping, the share of the episodes with and without a word that it must tell right, and
its error at least."""
_ODD_SHARE, _FEWEST_ODD = 0.05, 2
"""Of the episodes that a word's error leaves out, the farthest off: what is looked for is no measure of itself."""
_FEWEST_WORDS, _MOST_WORDS = 3, 60
"""Episodes that have a word, and that lack it, for it to be learned; and how many words are, the most frequent ones."""
_AGREED = 0.85
"""Share of the episodes that must show a colour for the others to lack it."""
_MOST, _SAME = 0.7, 0.1
"""Share of the episodes of an instruction that must show a colour, for it to be compared with other instructions; and
what those may lack at most of each other's colours."""
_HARDLY = 0.3
"""Share of what is usual of a colour, below which it is lacking: things differ in size."""
_LEAST = 0.01
"""Share of the image that something has at least, to be seen."""


def groups(tasks: Sequence[str]) -> list[list[int]]:
    """Numbers of the episodes that are compared with each other."""
    found: dict[str, list[int]] = {}
    for number, task in enumerate(tasks):
        found.setdefault(task, []).append(number)
    large = [numbers for numbers in found.values() if len(numbers) >= FEWEST]
    small = [number for numbers in found.values() if len(numbers) < FEWEST for number in numbers]
    return [*large, small] if small else large


def deviation(values: Array, floor: float) -> Array:
    """(N,) how far each is above the middle one, in units of the usual spread, of which `floor` is the least."""
    known = values[np.isfinite(values)]
    if not len(known):
        return np.zeros(len(values))
    middle = np.median(known)
    spread = max(_NORMAL * float(np.median(np.abs(known - middle))), floor)
    return np.asarray(np.nan_to_num((values - middle) / spread))


def left_out_residuals(inputs: Array, outputs: Array) -> Array:
    """(N, Q) what a linear model of all other rows gets wrong of each row (ridge regression, leave-one-out).

    Args:
        inputs: (N, P).
        outputs: (N, Q).
    """
    gram = inputs.T @ inputs
    gram += _DAMPING * np.trace(gram) / len(gram) * np.eye(len(gram))
    influence = np.linalg.solve(gram, inputs.T)
    leverage = np.einsum("np,pn->n", inputs, influence)
    return np.asarray((outputs - inputs @ (influence @ outputs)) / (1 - np.minimum(leverage, 0.9))[:, None])


def course_residuals(ends: Array, courses: Array) -> Array:
    """(N, S) how far each stretch of a course is from what others with such ends do, at its worst point.

    Args:
        ends: (N, S + 1, K) of the stretches.
        courses: (N, S, 12, K) of them.
    """
    count, stretches, points, width = courses.shape
    found = np.empty((count, stretches))
    for stretch in range(stretches):
        inputs = ends[:, stretch : stretch + 2].reshape(count, -1)
        inputs = np.concatenate([np.ones((count, 1)), inputs - inputs.mean(axis=0)], axis=1)
        residuals = left_out_residuals(inputs, courses[:, stretch].reshape(count, -1))
        found[:, stretch] = np.linalg.norm(residuals.reshape(count, points, width), axis=2).max(axis=1)
    return found


def cost_residuals(ends: Array, costs: Array) -> Array:
    """(N, S, 2) by how much each stretch takes longer, in seconds and in length, than those of others as far.

    Args:
        ends: (N, S + 1, K) of the stretches.
        costs: (N, S, 2) seconds and length.
    """
    found = np.empty_like(costs)
    for stretch in range(costs.shape[1]):
        way = np.abs(ends[:, stretch + 1] - ends[:, stretch])
        inputs = np.column_stack([np.ones(len(way)), np.linalg.norm(way, axis=1), way.max(axis=1)])
        if len(way) >= _ROWS_EACH * (inputs.shape[1] + way.shape[1]):
            inputs = np.concatenate([inputs, way - way.mean(axis=0)], axis=1)
        found[:, stretch] = left_out_residuals(inputs, costs[:, stretch])
    return found


def nearest_distance(points: Array, neighbours: int = 5) -> Array:
    """(N,) distance of each of (N, K) points to its nearest others, the middle one of five."""
    found = np.empty(len(points))
    for number, point in enumerate(points):
        away = np.sort(np.linalg.norm(points - point, axis=1))[1 : neighbours + 1]
        found[number] = np.median(away) if len(away) else 0.0
    return found


def words_of(tasks: Sequence[str]) -> Iterator[tuple[str, Flags]]:
    """(words, (N,) which instructions have them) of those that some have and some have not.

    Single words, and two words in an order that is the other one elsewhere: "red ... blue". Of those that the same
    instructions have the first ones stand for all.
    """
    texts = list(dict.fromkeys(tasks))
    lists = [list(dict.fromkeys(re.findall(r"\w+", text.lower()))) for text in texts]
    counts = Counter(word for words in lists for word in words)
    common = {word for word, _ in counts.most_common(_MOST_WORDS)}
    kept = [[word for word in words if word in common] for words in lists]
    single = [set(words) for words in kept]
    orders = {pair for words in kept for pair in combinations(words, 2)}
    pairs = [{f"{a} ... {b}" for a, b in combinations(words, 2) if (b, a) in orders} for words in kept]
    places = np.array([texts.index(task) for task in tasks])
    seen: set[bytes] = set()
    for terms in (single, pairs):
        for term in sorted(set().union(*terms)):
            has = np.array([term in of_text for of_text in terms])[places]
            if _FEWEST_WORDS <= has.sum() <= len(tasks) - _FEWEST_WORDS and has.tobytes() not in seen:
                seen |= {has.tobytes(), (~has).tobytes()}
                yield term, has


def contradicted_words(tasks: Sequence[str], looks: Array) -> tuple[Array, list[str]]:
    """How surely what is seen contradicts a word of the instruction, or the lack of it, and which word.

    For each word a linear model of all other episodes predicts from the colours whether the instruction has it. Words
    that it cannot predict (the verb, say) say nothing.

    Args:
        tasks: Instruction of each of N episodes.
        looks: (N, Q) shares of colours.

    Returns:
        (N,) how far off the worst word is, in units of the usual error, 0 where none is contradicted; (N,) the word.
    """
    worst, which = np.zeros(len(tasks)), [""] * len(tasks)
    centred = np.sqrt(looks) - np.sqrt(looks).mean(axis=0)
    gram = centred.T @ centred
    gram += (_RIDGE * np.trace(gram) / len(tasks) + 1e-12) * np.eye(len(gram))
    influence = np.linalg.solve(gram, centred.T)
    leverage = np.minimum(np.einsum("np,pn->n", centred, influence) + 1 / len(tasks), 0.95)
    for word, has in words_of(tasks):
        given = np.where(has, 1.0, -1.0)
        mean = given.mean()
        seen = given - (given - mean - centred @ (influence @ (given - mean))) / (1 - leverage)
        # A rare word is predicted too low everywhere: what is usual with it is 1, what is usual without it -1.
        high, low = float(np.median(seen[has])), float(np.median(seen[~has]))
        agrees = given * (2 * seen - high - low) / max(high - low, 1e-9)
        if high <= low or min((agrees[has] > 0).mean(), (agrees[~has] > 0).mean()) < _PREDICTED:
            continue
        usual = np.sort((1 - agrees) ** 2)[: -max(_FEWEST_ODD, round(_ODD_SHARE * len(tasks)))]
        error = max(float(np.sqrt(usual.mean())), _LEAST_ERROR)
        off = np.where(agrees < 0, 1 - agrees, 0.0) / error
        for number in np.flatnonzero(off > worst):
            worst[number], which[number] = off[number], word
    return worst, which


def lacking(colors: NDArray[np.float32], tasks: Sequence[str]) -> Array:
    """(N,) share of what others hold that each hand lacks; nan where hardly anything is seen in it, or few are alike.

    Compared are episodes of one instruction, and of others of which most hold the same. Where fewer than 85 in 100
    agree in a colour nothing lacks it.

    Args:
        colors: (N, 1176) as `Sight.held`.
        tasks: Instruction of each.
    """
    shares = _around(colors.reshape(-1, LIGHT, HUE, HUE), np.add)
    own = _around(shares, np.maximum)  # what is beside a usual colour is no other one
    found = np.full(len(colors), np.nan)
    for pool in _pools(shares, tasks, colors.sum(axis=1) >= _LEAST):
        if len(pool) >= FEWEST:
            found[pool] = _lack(np.quantile(shares[pool], 1 - _AGREED, axis=0), own[pool])
    return found


def _pools(shares: NDArray[np.float32], tasks: Sequence[str], seen: Flags) -> list[list[int]]:
    """Numbers of the episodes by what most of their instruction hold; those of which most do not agree are left out."""
    members: dict[str, list[int]] = {}
    for number in np.flatnonzero(seen).tolist():
        members.setdefault(tasks[number], []).append(number)
    pools: list[tuple[NDArray[np.float32], list[int]]] = []
    for numbers in sorted(members.values(), key=len, reverse=True):
        usual = np.quantile(shares[numbers], 1 - _MOST, axis=0)[None].astype(np.float32)
        if usual.max() < _LEAST:
            continue
        around = _around(usual, np.maximum)
        for other, pool in pools:
            if max(_lack(usual[0], _around(other, np.maximum))[0], _lack(other[0], around)[0]) < _SAME:
                pool += numbers
                break
        else:
            pools.append((usual, numbers))
    return [pool for _, pool in pools]


def _lack(usual: Array | NDArray[np.float32], own: NDArray[np.float32]) -> Array:
    """(N,) share of what is usual (...) that each of (N, ...) lacks."""
    if usual.max() < _LEAST:
        return np.zeros(len(own))
    lack = np.maximum(1 - own / np.maximum(_HARDLY * usual, 1e-9), 0.0) * usual
    return np.asarray(lack.sum(axis=(1, 2, 3)) / usual.sum())


def _around(shares: NDArray[np.float32], join: np.ufunc) -> NDArray[np.float32]:
    """(N, ...) joined with the bins beside, along all axes but the first."""
    for axis in range(1, shares.ndim):
        width = [(0, 0)] * shares.ndim
        width[axis] = (1, 1)
        padded = np.moveaxis(np.pad(shares, width), axis, 0)
        shares = np.moveaxis(join(join(padded[:-2], padded[1:-1]), padded[2:]), 0, axis)
    return shares
