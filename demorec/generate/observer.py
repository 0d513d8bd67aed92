"""What is told about a run: while it goes, to an observer, and at its end, as a result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from demorec.runs.run_file import Attempt, RunFile, RunSession


class RunObserver:
    """Told how a run goes; does nothing itself."""

    def verifying(self, done: int, total: int) -> None:
        """Recordings of an earlier session are being verified."""

    def started(self, run: RunFile, workers: int) -> None:
        """The work begins; `run` knows what is there already."""

    def ended(self, attempt: Attempt) -> None:
        """An attempt has come to its end."""

    def says(self, message: str) -> None:
        """Something that a person should know."""


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """What a session has come to.

    Attributes:
        folder: Of the run.
        run: All that is known now, earlier sessions included.
        session: This one.
        made: The attempts of this session.
        interrupted: Whether Ctrl-C or SIGTERM ended it.
    """

    folder: Path
    run: RunFile
    session: RunSession
    made: tuple[Attempt, ...]
    interrupted: bool
