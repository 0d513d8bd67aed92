"""What differs between a recording and the same made again, by stream, field and frame."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterator
from dataclasses import dataclass

from demorec.mcap.messages import Value

_SHOWN = reprlib.Repr(maxstring=80, maxother=80)


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One field of one stream that is not what it is when the recording is made again.

    Attributes:
        stream: A topic, or "metadata NAME", "attachment NAME".
        field: Of its messages, as `pose.position.x`, or of the metadata, as `info.scene.bodies[1].mass`; "image" for
            what a camera shows.
        frames: In which, ascending; empty for what belongs to no frame.
        recorded, again: What is recorded and what comes out, at the first of these frames, in words; `again` is ""
            where `recorded` says it all.
        largest: Largest absolute difference over these frames; None of what is no number.
        is_coding: Whether an image is coded otherwise, but shows the same within the coder's own error.
    """

    stream: str
    field: str
    frames: tuple[int, ...] = ()
    recorded: str
    again: str
    largest: float | None = None
    is_coding: bool = False

    @property
    def first_frame(self) -> int:
        """For the order: what belongs to no frame comes first."""
        return self.frames[0] if self.frames else -1

    def __str__(self) -> str:
        where = f"{self.stream} {self.field}"
        if self.frames:
            where += f" at frame {self.frames[0]}"
            if len(self.frames) > 1:
                where += f" (and {len(self.frames) - 1} more, the last is {self.frames[-1]})"
        if not self.again:
            return f"{where}: {self.recorded}"
        text = f"{where}: {self.recorded} is recorded, made again it is {self.again}"
        return text if self.largest is None or len(self.frames) < 2 else f"{text}; at most {self.largest:.3g} apart"


def difference_in_words(value: Value | None) -> str:
    """A value as a person reads it; None is what is missing."""
    if value is None:
        return "nothing"
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return repr(value) if isinstance(value, bool | int | float) else _SHOWN.repr(value)


class Differences:
    """Gathers differing values; those of one field over all frames become one `Difference`."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str], tuple[list[int], str, str, float | None]] = {}

    def add(self, stream: str, field: str, frame: int | None, recorded: Value | None, again: Value | None) -> None:
        """Two values that differ."""
        frames, first, first_again, largest = self._found.setdefault(
            (stream, field), ([], difference_in_words(recorded), difference_in_words(again), None)
        )
        if frame is not None and (not frames or frames[-1] != frame):
            frames.append(frame)
        apart = _apart(recorded, again)
        if apart is not None:
            largest = apart if largest is None or not apart <= largest else largest
        self._found[stream, field] = frames, first, first_again, largest

    def __iter__(self) -> Iterator[Difference]:
        for (stream, field), (frames, recorded, again, largest) in self._found.items():
            yield Difference(
                stream=stream, field=field, frames=tuple(frames), recorded=recorded, again=again, largest=largest
            )


def _apart(a: Value | None, b: Value | None) -> float | None:
    if isinstance(a, bool) or isinstance(b, bool) or not isinstance(a, int | float) or not isinstance(b, int | float):
        return None
    return abs(a - b) if math.isfinite(a) and math.isfinite(b) else math.inf
