"""Any recording, of a simulated or of a collected episode, opened as what it is."""

from __future__ import annotations

from pathlib import Path

from demorec.core.errors import RecordingError
from demorec.mcap.external.reader import CollectedRecording
from demorec.mcap.reader import CollectedEpisodeError
from demorec.mcap.recording import Recording

AnyRecording = Recording | CollectedRecording


def open_recording(path: str | Path) -> AnyRecording:
    """Open a recording; RecordingError as `Recording` and `CollectedRecording`."""
    try:
        return Recording(path)
    except CollectedEpisodeError:
        return CollectedRecording(path)


def is_collected(path: Path) -> bool:
    """Whether a file is the recording of a collected episode; False for what cannot be read."""
    try:
        with open_recording(path) as recording:
            return isinstance(recording, CollectedRecording)
    except RecordingError:
        return False
