"""Checks of time: gaps, repeated and reversed timestamps, a different rate than stated, old samples."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from demorec.check.base import Fault, NotApplicableError, NotMeasuredError, check
from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import DROP, EpisodeEvidence, Evidence
from demorec.extensions.doctor.robust import MAX_PERIOD, held_period
from demorec.extensions.doctor.units import MIN_MOTION_TICKS, element_ticks

MAX_GAP_PERIODS = 2.5
"""Maximum periods between two frames without missing ones; one late frame takes two."""
NEIGHBOURS = 5
"""Number of frames on each side of a gap that show the speed of the state there."""
MAX_REST = 0.002
"""Maximum step of an arm at rest between two frames, as a ratio of an element's usual range."""
MIN_SPAN = 0.01
"""Minimum usual range of an element, relative to the largest, whose steps are more than noise."""
MAX_RATE_ERROR = 0.1
"""Maximum relative error of the measured rate; above it motion has a wrong speed."""
MIN_FRAMES = 5
MIN_MOTION = 0.05
"""Minimum motion of an element within six frames, as a ratio of its range in the episode: each new sample shows it."""
MAX_AGE_S = 0.2
"""Maximum age of a sample or an image, in seconds; above it a policy sees the past: people react in that time."""


def _timed(evidence: Evidence) -> Iterator[tuple[EpisodeEvidence, Array]]:
    found = [(each, each.time_s) for each in evidence.episodes if each.time_s is not None and len(each.time_s) >= 2]
    if not found:
        raise NotMeasuredError("timestamps are missing")
    yield from found


@check(
    family="time",
    needs="timestamps",
    measures="frames that are missing between others",
    unit="s",
    why="What happened in the gap is lost, so the preceding action seems to have a larger effect than it had.",
    do="look at it: demorec view {path} --episodes {episode}; then cut or drop it: " + DROP,
)
def time_gaps(evidence: Evidence) -> Iterator[Fault]:
    """Find the longest time between two frames of each episode, in periods of the stated rate."""
    for episode, times in _timed(evidence):
        steps = np.diff(times)
        if _is_of_other_rate(steps, evidence.fps):
            continue
        gaps = np.flatnonzero(steps * evidence.fps > MAX_GAP_PERIODS)
        if len(gaps):
            motion = _motion(evidence, episode)
            moving = np.array([gap for gap in gaps if not _rests(motion, int(gap))], dtype=np.intp)
            judged = moving if len(moving) else gaps
            longest = int(judged[np.argmax(steps[judged])])
            more = f", and {len(gaps) - 1} more gaps" if len(gaps) > 1 else ""
            seconds = float(steps[longest])
            moves_on = len(moving) > 0 and _moves_on(motion, longest, seconds * evidence.fps)
            what = "the state moves on as usual, but its clock jumps by {} s" if moves_on else "{} s pass"
            yield Fault(
                severity="broken" if len(moving) else "look",
                episode=episode.number,
                frames=(int(gaps[0]) + 1, int(gaps[-1]) + 1),
                value=f"{seconds:.2f} s",
                message=f"{what.format(f'{seconds:.2f}')} before frame {longest + 1}{more}",
                do="write frame_index / fps as the timestamp, and convert it again" if moves_on else "",
            )


def _motion(evidence: Evidence, episode: EpisodeEvidence) -> Array | None:
    """Compute the (T - 1,) largest step of the state's elements, in their usual ranges; None if unknown."""
    if episode.state is None:
        return None
    alive = evidence.ranges > MIN_SPAN * evidence.ranges.max(initial=0.0)
    steps = np.abs(np.diff(episode.state[:, alive], axis=0)) / evidence.ranges[alive]
    return np.asarray(steps.max(axis=1, initial=0.0))


def _around(motion: Array, frame: int) -> float:
    """Compute the median step of the frames around a gap."""
    around = motion[max(frame - NEIGHBOURS, 0) : frame + NEIGHBOURS + 1]
    return float(np.median(np.delete(around, min(frame, NEIGHBOURS))))


def _rests(motion: Array | None, frame: int) -> bool:
    """Check whether the arm is known to rest before, during, and after a gap."""
    return motion is not None and max(float(motion[frame]), _around(motion, frame)) <= MAX_REST


def _moves_on(motion: Array | None, frame: int, periods: float) -> bool:
    """Check whether the state after a gap, at a known frame, is where it would be one frame later."""
    return motion is not None and bool(motion[frame] < _around(motion, frame) * periods / 4)


def _is_of_other_rate(steps: Array, fps: float) -> bool:
    return abs(float(np.median(steps)) * fps - 1) > 0.5


@check(
    family="time",
    needs="timestamps",
    measures="timestamps that repeat or run backwards",
    unit="frames",
    why="LeRobot finds images by a row's timestamp, so it finds wrong ones or none.",
    do=DROP,
)
def time_order(evidence: Evidence) -> Iterator[Fault]:
    """Count the frames with a timestamp that is not after the previous one."""
    for episode, times in _timed(evidence):
        wrong = np.flatnonzero(np.diff(times) <= 0)
        if len(wrong):
            yield Fault(
                severity="broken",
                episode=episode.number,
                frames=(int(wrong[0]) + 1, int(wrong[-1]) + 1),
                value=f"{len(wrong)} frames",
                message=f"the timestamps of {len(wrong)} frames repeat or run backwards, first at frame {wrong[0] + 1}",
            )


@check(
    family="time",
    needs="timestamps",
    measures="a rate that differs from the stated one",
    unit="Hz",
    why="Policies act at the stated rate, so their motion is faster or slower than demonstrated.",
    do="set fps to the measured rate in the recorder, and record or convert again",
)
def frame_rate(evidence: Evidence) -> Iterator[Fault]:
    """Compare the median rate of the timestamps with the stated one, over the set and for each episode."""
    rates = {e.number: 1 / step for e, t in _timed(evidence) if len(t) >= MIN_FRAMES and (step := _period(t)) > 0}
    if not rates:
        raise NotMeasuredError(f"no episode has {MIN_FRAMES} frames with timestamps")
    wrong = {number: rate for number, rate in rates.items() if abs(rate / evidence.fps - 1) > MAX_RATE_ERROR}
    if len(wrong) > len(rates) / 2:
        rate = float(np.median(list(wrong.values())))
        yield Fault(
            severity="broken",
            value=f"{rate:.3g} Hz",
            message=f"the frames are {1 / rate:.3g} s apart ({rate:.3g} Hz); the stated rate is {evidence.fps:g} Hz",
        )
        return
    for number, rate in wrong.items():
        yield Fault(
            severity="broken",
            episode=number,
            value=f"{rate:.3g} Hz",
            message=f"its frames are at {rate:.3g} Hz instead of the stated {evidence.fps:g} Hz",
            do=DROP,
        )


def _period(times: Array) -> float:
    return float(np.median(np.diff(times)))


@check(
    family="time",
    needs="timestamps",
    measures="measured timestamps off the grid of the rate",
    unit="ms",
    why="LeRobot refuses timestamps that are more than 0.1 ms off, and decodes the image of another moment.",
    do="write frame_index / fps as the timestamp when converting; store measured times in a separate column",
)
def time_grid(evidence: Evidence) -> Iterator[Fault]:
    """Compare the timestamps of a dataset with frame_index / fps, as LeRobot does when it loads one."""
    if evidence.folder is None:
        raise NotApplicableError("recordings have their own timestamps")
    from demorec.extensions.datasets.episode_places import are_on_grid

    worst: dict[int, float] = {}
    for episode, times in _timed(evidence):
        first = float(times[0])
        if not are_on_grid(times, int(evidence.fps), first if evidence.folder.info.is_old else 0.0):
            worst[episode.number] = float(np.abs(times - times[0] - np.arange(len(times)) / evidence.fps).max())
            worst[episode.number] = max(worst[episode.number], abs(first))
    if len(worst) > max(1, len(evidence.episodes) / 2):
        largest = max(worst.values())
        yield Fault(
            severity="look",
            value=f"{1000 * largest:.1f} ms",
            message=f"timestamps of {len(worst)} episodes are off frame_index / fps by up to {1000 * largest:.1f} ms",
        )
        return
    for number, error in worst.items():
        yield Fault(
            severity="broken",
            episode=number,
            value=f"{1000 * error:.1f} ms",
            message=f"its timestamps are up to {1000 * error:.1f} ms off frame_index / fps",
            do=DROP,
        )


@check(
    family="time",
    needs="timestamps of samples and images",
    measures="samples and images older than their frame",
    unit="s",
    why="The policy sees the past: it reacts late, or to a scene that is gone.",
    do=DROP,
)
def sample_age(evidence: Evidence) -> Iterator[Fault]:
    """Compare the timestamps of samples and images with those of their frames, stream by stream."""
    if not any(episode.image_ages_s for episode in evidence.episodes):
        raise NotApplicableError("samples have no separate timestamps")
    for episode in evidence.episodes:
        for name, ages in episode.image_ages_s.items():
            old = np.abs(ages) > MAX_AGE_S
            if old.any():
                frames = np.flatnonzero(old)
                worst = float(np.nanmax(np.abs(ages)))
                yield Fault(
                    severity="broken" if old.mean() > 0.2 or worst > 5 * MAX_AGE_S else "look",
                    episode=episode.number,
                    frames=(int(frames[0]), int(frames[-1])),
                    value=f"{worst:.2f} s",
                    message=f"{name} is up to {worst:.2f} s away from its frame, in {len(frames)} frames",
                )


@check(
    family="time",
    needs="state",
    measures="states slower than the frames",
    unit="frames",
    why="The policy sees a state of several frames ago, and no speed.",
    do="read the robot at the rate of the frames, or record at the rate of the robot",
)
def held_samples(evidence: Evidence) -> Iterator[Fault]:
    """Find states that change only in every n-th frame while the arm moves by ten encoder steps and more."""
    periods: dict[int, int] = {}
    ticks = evidence.once(element_ticks)
    for episode, state in evidence.need_state(3 * MAX_PERIOD):
        least = np.maximum(MIN_MOTION_TICKS * ticks, MIN_MOTION * np.ptp(state, axis=0))
        moves = (np.abs(state[MAX_PERIOD:] - state[:-MAX_PERIOD]) > least)[:, ~evidence.is_gripper].any(axis=1)
        repeats = (state[1:] == state[:-1]).all(axis=1)[MAX_PERIOD : len(moves)]
        periods[episode.number] = held_period(repeats, moves[:-MAX_PERIOD] & moves[MAX_PERIOD:])
    held = {number: period for number, period in periods.items() if period > 1}
    if len(held) > len(periods) / 2:
        period = int(np.median(list(held.values())))
        yield Fault(
            severity="look",
            value=f"{period} frames",
            message=f"the state changes only once in {period} frames: it is read at {evidence.fps / period:.3g} Hz",
        )
        return
    for number, period in held.items():
        yield Fault(
            severity="look",
            episode=number,
            value=f"{period} frames",
            message=f"its state changes only once in {period} frames",
        )


@check(
    family="time",
    needs="a recorder that counts its losses",
    measures="frames and images lost while recording",
    unit="frames",
    why="The disk, the network or the camera was too slow: the remaining frames are not at the stated rate.",
    do="record at a lower rate or size, or on another disk",
)
def recording_losses(evidence: Evidence) -> Iterator[Fault]:
    """Report the frames and images that the recorder itself counted as dropped."""
    if evidence.folder is not None:
        raise NotApplicableError("LeRobot datasets do not record losses")
    for episode in evidence.episodes:
        if episode.drops:
            yield Fault(severity="look", episode=episode.number, value=episode.drops, message=f"lost: {episode.drops}")
