"""What is said when somebody corrects the expert: the user's words and the answer to them."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from demorec.annotate.referring import phrases_for
from demorec.annotate.situation import Surroundings
from demorec.episode.episode import INTERJECTION_EVENT, SimulatedColumns
from demorec.mcap import SimulatedRecording

_SAID = (
    "No, {wanted} is meant.",
    "Stop, take {wanted}.",
    "Wait, I want {wanted}.",
    "Not that one: {wanted}, please.",
)
_SAID_OF_BOTH = (
    "No, not {mistaken}: {wanted}.",
    "Stop, that is {mistaken}. Take {wanted}.",
    "Leave {mistaken} alone, I want {wanted}.",
    "Wait, {wanted} is meant, not {mistaken}.",
)
_ANSWERED = (
    "Sorry, I will take {wanted}.",
    "All right, {wanted}.",
    "I see: {wanted}.",
    "Of course, {wanted}.",
)


@dataclass(frozen=True, kw_only=True)
class Correction:
    """An interjection of a recording.

    Attributes:
        frame: At which it comes.
        wanted, mistaken: Names of the thing that is meant, and of the one that the expert went for.
    """

    frame: int
    wanted: str
    mistaken: str


def correction_of(recording: SimulatedRecording, columns: SimulatedColumns) -> Correction | None:
    """The interjection of a recording; None without one.

    Raises:
        RecordingError: It is damaged.
    """
    names = {body.name for body in recording.info.scene.bodies}
    for time_ns, event in recording.events():
        match = re.fullmatch(r"(\S+) is meant, not (\S+)", event.message)
        if event.name == INTERJECTION_EVENT and match and {match[1], match[2]} <= names:
            frame = int(np.searchsorted(columns.time_ns, time_ns))
            return Correction(frame=frame, wanted=match[1], mistaken=match[2])
    return None


def interjection(correction: Correction, now: Surroundings, rng: np.random.Generator) -> tuple[str, str] | None:
    """What the user says and what is answered; None where no words mean the wanted thing alone."""
    wanted, mistaken = (phrases_for(name, now) for name in (correction.wanted, correction.mistaken))
    if not wanted:
        return None
    forms = (*_SAID, *_SAID_OF_BOTH) if mistaken else _SAID
    said, answered = forms[int(rng.integers(len(forms)))], _ANSWERED[int(rng.integers(len(_ANSWERED)))]
    words = {"wanted": wanted[0], "mistaken": mistaken[0] if mistaken else ""}
    return said.format_map(words), answered.format_map(words)
