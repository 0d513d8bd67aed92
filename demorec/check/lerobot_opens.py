"""Whether LeRobot opens a dataset."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile

from demorec.check.base import Measurement, dataset_check
from demorec.check.dataset import CheckedDataset
from demorec.core.errors import MissingDependencyError, ResourceError
from demorec.datasets.lerobot.inspect import dataset_problems
from demorec.datasets.lerobot.verify import LEROBOT, lerobot_is_installed

_TIMEOUT_S = 600
_NO_MEMORY = re.compile(
    r"MemoryError|bad_alloc|out of memory|allocate memory|unable to allocate|(m|re)alloc of size|failed to map segment"
    r"|can't start new thread",
    re.IGNORECASE,
)
"""How Python, NumPy, PyTorch, Arrow and the dynamic linker report too little memory."""
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


@dataset_check(
    measures="errors when the installed LeRobot opens it",
    needs_images=True,
)
def dataset_opens(dataset: CheckedDataset) -> Measurement | None:
    """Let LeRobot open the dataset and read the first, middle and last frame, images included."""
    if dataset.info.is_old:  # LeRobot 0.6 reads v3.0 alone
        return None
    if not lerobot_is_installed():
        raise MissingDependencyError("Opening a dataset as a training does", "lerobot", f"pip install '{LEROBOT}'")
    with tempfile.TemporaryDirectory(prefix="demorec-check-") as cache:
        environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "HF_DATASETS_CACHE": cache}
        try:
            done = subprocess.run(
                [sys.executable, "-c", _OPEN, str(dataset.path)],
                capture_output=True,
                text=True,
                errors="replace",
                env=environment,
                timeout=_TIMEOUT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return Measurement(value=1, detail=f"LeRobot has not opened it after {_TIMEOUT_S} s")
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        said = re.sub(r"^[\w.]+: ", "", lines[-1])[:200] if lines else f"it ends with the exit status {done.returncode}"
        if not done.stdout.startswith("loaded") or done.returncode == -signal.SIGKILL or _NO_MEMORY.search(done.stderr):
            raise ResourceError(
                f"LeRobot could not be tried ({said.strip().rstrip('.')}): is there too little memory? Free some, or "
                f"raise the limit (ulimit -v); whether the dataset is sound is not known: {dataset.path}"
            )
        # It asks the Hub for files that are missing here, and complains that it may not.
        problems = dataset_problems(dataset.folder)
        return Measurement(value=1, detail=f"LeRobot cannot open it ({problems[0] if problems else said})")
    found = json.loads(done.stdout.splitlines()[-1])
    same = (found["episodes"], found["frames"]) == (dataset.info.total_episodes, dataset.info.total_frames)
    return Measurement(value=int(not same), detail=f"{found['episodes']} episodes, {found['frames']} frames")
