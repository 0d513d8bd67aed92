"""Check that the installed LeRobot opens a dataset."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator

from demorec.check.base import Fault, NotApplicableError, NotMeasuredError, check
from demorec.core.errors import MissingDependencyError, ResourceError
from demorec.datasets.lerobot.verify import LEROBOT, lerobot_is_installed
from demorec.extensions.datasets.inspect import dataset_problems
from demorec.extensions.doctor.checks.files import folder_of
from demorec.extensions.doctor.evidence import Evidence

_TIMEOUT_S = 600
_NO_MEMORY = re.compile(
    r"MemoryError|bad_alloc|out of memory|allocate memory|unable to allocate|(m|re)alloc of size|failed to map segment"
    r"|can't start new thread",
    re.IGNORECASE,
)
"""Phrases of Python, NumPy, PyTorch, Arrow and the dynamic linker for too little memory."""
_OPEN = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
print("loaded", flush=True)
dataset = LeRobotDataset(repo_id="local/check", root=sys.argv[1])
frames = sorted({0, len(dataset) // 2, len(dataset) - 1})
for frame in frames:
    item = dataset[frame]
    assert int(item["index"]) == frame, f"row {frame} has index {int(item['index'])}"
print(json.dumps({"episodes": dataset.num_episodes, "frames": len(dataset)}))
"""


@check(
    family="files",
    needs="LeRobot, by --lerobot",
    measures="errors when LeRobot opens the dataset",
    why="Training begins by opening it.",
    do="fix the other findings first; then report the error at github.com/huggingface/lerobot",
)
def lerobot_opens(evidence: Evidence) -> Iterator[Fault]:
    """Open the dataset with the installed LeRobot and read the first, middle and last frame, images included."""
    folder = folder_of(evidence)
    if not evidence.opens_lerobot:
        raise NotApplicableError("LeRobot is started only with --lerobot, which takes seconds")
    if folder.info.is_old:
        raise NotMeasuredError("LeRobot 0.6 reads only v3.0: demorec dataset select writes it")
    if not lerobot_is_installed():
        raise MissingDependencyError("Opening a dataset as a training does", "lerobot", f"pip install '{LEROBOT}'")
    with tempfile.TemporaryDirectory(prefix="demorec-check-") as cache:
        environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "HF_DATASETS_CACHE": cache}
        try:
            done = subprocess.run(
                [sys.executable, "-c", _OPEN, str(evidence.path)],
                capture_output=True,
                text=True,
                errors="replace",
                env=environment,
                timeout=_TIMEOUT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            yield Fault(severity="broken", message=f"LeRobot has not opened it after {_TIMEOUT_S} s")
            return
    if done.returncode != 0:
        yield Fault(severity="broken", message=f"LeRobot cannot open it ({_reason(evidence, done)})")
        return
    found = json.loads(done.stdout.splitlines()[-1])
    if (found["episodes"], found["frames"]) != (folder.info.total_episodes, folder.info.total_frames):
        yield Fault(
            severity="broken",
            message=f"LeRobot finds {found['episodes']} episodes of {found['frames']} frames, unlike info.json",
        )


def _reason(evidence: Evidence, done: subprocess.CompletedProcess[str]) -> str:
    """Determine why LeRobot failed. Raises ResourceError if this machine is the reason."""
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    said = re.sub(r"^[\w.]+: ", "", lines[-1])[:200] if lines else f"it ends with the exit status {done.returncode}"
    if not done.stdout.startswith("loaded") or done.returncode == -signal.SIGKILL or _NO_MEMORY.search(done.stderr):
        raise ResourceError(
            f"LeRobot could not be tried ({said.strip().rstrip('.')}): free memory or raise its limit "
            f"(ulimit -v). Whether the dataset is sound is unknown: {evidence.path}"
        )
    # LeRobot asks the Hub for files that are missing here, and reports that it is not allowed to.
    problems = dataset_problems(folder_of(evidence))
    return problems[0] if problems else said
