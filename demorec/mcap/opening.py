"""Any recording, of a simulated or of a collected episode, opened as what it is."""

from __future__ import annotations

from pathlib import Path

from demorec.core.errors import RecordingError
from demorec.mcap.external.reader import Recording
from demorec.mcap.reader import NotSimulatedError
from demorec.mcap.recording import SimulatedRecording

AnyRecording = SimulatedRecording | Recording


def open_recording(path: str | Path) -> AnyRecording:
    """Open a recording; RecordingError as `SimulatedRecording` and `Recording`."""
    try:
        return SimulatedRecording(path)
    except NotSimulatedError:
        return Recording(path)


def is_external(path: Path) -> bool:
    """Whether a file is the recording of a collected episode; False for what cannot be read."""
    try:
        with open_recording(path) as recording:
            return isinstance(recording, Recording)
    except RecordingError:
        return False
