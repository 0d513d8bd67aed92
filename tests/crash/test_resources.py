"""Too little memory and too few file descriptors: reported as such, never as damaged input."""

from __future__ import annotations

from pathlib import Path

import pytest
import zstandard
from support.recording import write_episode

from demorec.core.errors import ResourceError
from demorec.mcap import container
from demorec.runs.recorded import inspect_recording


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        zstandard.ZstdError("decompression error: Allocation error : not enough memory"),  # its message under ulimit -v
        OSError("libllvmlite.so: failed to map segment from shared object"),
    ],
)
def test_a_recording_for_which_memory_is_too_small_is_not_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    path = write_episode(tmp_path / "good.mcap", cameras=(), num_frames=5)

    def fail(*_: object) -> bytes:
        raise error

    monkeypatch.setattr(container, "chunk_content", fail)
    with pytest.raises(ResourceError, match="too little memory") as told:
        inspect_recording(path)
    assert "damaged" not in str(told.value)
