"""Faults that recorders, networks, drivers and people cause in bags, each as a change of a layout's messages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from support.bags import NS, Note, Notes, changed, in_order, jpeg, with_body

STATE, ACTION = "/follower/joint_states", "/leader/joint_states"
FRONT, SIDE = "/follower/cam_front/image_raw/compressed", "/static_camera/cam_side/image_raw/compressed"


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault of a bag.

    Attributes:
        kind: The finding that must name it; "" if only the refusal does.
        hurt: Function that makes it; messages are in the order of recording.
        is_refused: Whether the import must refuse the episode.
    """

    kind: str
    hurt: Callable[[Notes], Notes]
    is_refused: bool = False


def _each(topic: str, change: Callable[[int, Note], Note | None]) -> Callable[[Notes], Notes]:
    return lambda notes: changed(notes, topic, change)


def _later(note: Note, seconds: float) -> Note:
    return replace(note, header_ns=note.header_ns + round(seconds * NS))


def _swapped_times(notes: Notes) -> Notes:
    """Swap the times of ten pairs of neighbours."""
    mine = [k for k, note in enumerate(notes) if note.topic == STATE][10:30]
    result = list(notes)
    for a, b in zip(mine[::2], mine[1::2], strict=True):
        result[a], result[b] = notes[b], notes[a]
    return result


def _repeated(notes: Notes) -> Notes:
    return [
        copy
        for k, note in enumerate(notes)
        for copy in ([note, note] if note.topic == STATE and k % 3 == 0 else [note])
    ]


def _halved(notes: Notes) -> Notes:
    for topic in (FRONT, SIDE):
        notes = changed(notes, topic, lambda k, note: note if k % 2 else None)
    return notes


def _resized(number: int, note: Note) -> Note:
    if number < 40:
        return note
    return with_body(note, data=np.frombuffer(jpeg(np.zeros((24, 32, 3), np.uint8)), np.uint8))


def _cut_image(number: int, note: Note) -> Note:
    return with_body(note, data=note.body["data"][:300]) if number % 20 == 7 else note


def _garbage(number: int, note: Note) -> Note:
    return replace(note, data=b"\x00\x01\x00\x00abc") if number in (20, 21) else note


FAULTS: dict[str, Fault] = {
    "a clock half a second behind": Fault(kind="clock_offset", hurt=_each(STATE, lambda k, n: _later(n, -0.5))),
    "a clock of another epoch": Fault(
        kind="clock_offset", hurt=_each(ACTION, lambda k, n: _later(n, -1e6)), is_refused=True
    ),
    "a clock that jumps ahead": Fault(
        kind="clock_drift", hurt=_each(STATE, lambda k, n: _later(n, 0.4) if k > 60 else n), is_refused=True
    ),
    "images that are stamped after their recording": Fault(
        kind="clock_offset", hurt=_each(SIDE, lambda k, n: _later(n, 0.08))
    ),
    "a clock that drifts": Fault(kind="clock_drift", hurt=_each(STATE, lambda k, n: _later(n, 0.0008 * k))),
    "headers without time": Fault(
        kind="unstamped", hurt=_each(STATE, lambda k, n: replace(n, header_ns=0) if k % 3 == 0 else n)
    ),
    "images lost": Fault(kind="drops", hurt=_each(FRONT, lambda k, n: None if k in (20, 21, 40) else n)),
    "a pause within the allowed age": Fault(kind="gap", hurt=_each(ACTION, lambda k, n: None if 40 <= k < 47 else n)),
    "a long pause": Fault(kind="gap", hurt=_each(FRONT, lambda k, n: None if 20 <= k < 35 else n), is_refused=True),
    "a stream that begins late": Fault(kind="late_start", hurt=_each(SIDE, lambda k, n: n if k > 20 else None)),
    "a stream that ends early": Fault(kind="early_end", hurt=_each(ACTION, lambda k, n: n if k < 65 else None)),
    "duplicated messages": Fault(kind="duplicates", hurt=_repeated),
    "messages in the wrong order": Fault(kind="order", hurt=_swapped_times),
    "messages that cannot be decoded": Fault(kind="malformed", hurt=_each(STATE, _garbage)),
    "images cut off": Fault(kind="malformed", hurt=_each(FRONT, _cut_image)),
    "a camera that changes its size": Fault(kind="", hurt=_each(FRONT, _resized), is_refused=True),
    "cameras of half the rate": Fault(kind="repeats", hurt=_halved),
}


def hurt(notes: Notes, name: str) -> Notes:
    """Messages with a fault, in the order of recording."""
    return FAULTS[name].hurt(in_order(notes))
