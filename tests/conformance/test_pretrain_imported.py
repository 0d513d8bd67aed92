"""act-keypoints-pretrain on imported recordings: an HDF5 file in robomimic's layout, imported and exported."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from lerobot_datasets import SMALL_ACT
from numpy.typing import NDArray
from support.commands import exit_code

from lerobot_policy_act_keypoints.commands import act_keypoints_pretrain

pytestmark = pytest.mark.usefixtures("hf_datasets_cache")

WIDTH, HEIGHT, PIXELS_PER_METRE = 64, 48, 100
REACH, CARRY = 8, 8
MAPPING = """
[robot]
name = "Panda"
[task]
text = "bring red to green"
[clock]
fps = 10
[episodes]
group = "data"
[[features."observation.state"]]
dataset = "obs/robot0_eef_pos"
[[features."observation.state"]]
dataset = "obs/robot0_gripper_qpos"
[[features."observation.ee_pose"]]
dataset = "obs/robot0_eef_pos"
names = ["tcp.x", "tcp.y", "tcp.z"]
[[features."observation.ee_pose"]]
dataset = "obs/robot0_eef_quat"
names = ["tcp.qx", "tcp.qy", "tcp.qz", "tcp.qw"]
[[features.action]]
dataset = "actions"
names = ["tcp.dx", "tcp.dy", "tcp.dz", "tcp.drx", "tcp.dry", "tcp.drz", "gripper.width"]
[cameras.agentview]
dataset = "obs/agentview_image"
"""


def seen(places: list[tuple[NDArray[np.float64], tuple[int, int, int]]]) -> NDArray[np.uint8]:
    """The table from above: a square of 5 cm at each place (x, y in metres), the later above the earlier ones."""
    shown = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    for (x, y, *_), color in places:
        is_near = np.maximum(abs(columns / PIXELS_PER_METRE - x), abs(rows / PIXELS_PER_METRE - y)) < 0.025
        shown[is_near] = color
    return shown


def write_recordings(path: Path, count: int) -> None:
    """A hand that goes straight to a red square, closes, brings it to a green one and opens; seen from above."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for number in range(count):
            start, thing, goal = rng.uniform((0.05, 0.05, 0.1), (0.59, 0.43, 0.1), (3, 3))
            ways = [(start, thing, REACH), (thing, goal, CARRY), (goal, start, 2)]
            tcp = np.concatenate([np.linspace(a, b, steps, endpoint=False) for a, b, steps in ways])
            frame = np.arange(len(tcp))
            is_closed = (frame >= REACH) & (frame < REACH + CARRY)
            at = np.where((frame < REACH)[:, None], thing, np.where(is_closed[:, None], tcp, goal))
            moves = np.diff(tcp, axis=0, append=tcp[-1:])
            closes = np.where(is_closed, 1.0, -1.0)[:, None]  # as robosuite counts: open is -1
            demo = file.create_group(f"data/demo_{number}")
            demo["actions"] = np.hstack([moves, np.zeros_like(moves), closes])
            demo["obs/robot0_eef_pos"] = tcp
            demo["obs/robot0_eef_quat"] = np.tile([1.0, 0, 0, 0], (len(tcp), 1))  # it looks down
            demo["obs/robot0_gripper_qpos"] = 0.04 * ~is_closed[:, None] * np.array([[1, -1]])
            places = zip(at, tcp, strict=True)
            images = [seen([(goal, (40, 200, 60)), (a, (230, 30, 30)), (b, (250, 250, 250))]) for a, b in places]
            demo["obs/agentview_image"] = np.stack(images)


def pretrained(folder: Path, *, episodes: int) -> dict[str, float]:
    """The result of one update on these recordings, imported and exported by the commands of docs/import.md."""
    write_recordings(folder / "bring.hdf5", episodes)
    (folder / "bring.toml").write_text(MAPPING)
    words = ["import", "hdf5", folder / "bring.hdf5", "--mapping", folder / "bring.toml", "--out", folder / "run"]
    assert exit_code(*words) == 0
    assert exit_code("export", "lerobot", folder / "run", "--out", folder / "dataset", "--no-verify") == 0
    policy = {**SMALL_ACT, "type": "act_keypoints", "num_keypoints": 8, "encoder_channels": 8}
    dataset = {"repo_id": "local/test", "root": str(folder / "dataset"), "video_backend": "pyav"}
    (folder / "settings.json").write_text(json.dumps({"dataset": dataset, "policy": policy}))
    words = [f"--config_path={folder / 'settings.json'}", "--num-updates", 1, "--frames-per-update", 32]
    assert exit_code(*words, "--out", folder / "eye", program=act_keypoints_pretrain) == 0
    found: dict[str, float] = json.loads((folder / "eye" / "pretraining.json").read_text())["result"]
    return found


def test_what_is_to_be_told_follows_from_the_file(tmp_path: Path) -> None:
    """How far off the mean is, from the poses and commands of the HDF5 file itself."""
    found = pretrained(tmp_path, episodes=8)
    first, known = [], {1.0: [], -1.0: []}  # type: ignore[var-annotated]
    with h5py.File(tmp_path / "bring.hdf5") as file:
        for number in range(8):
            demo = file[f"data/demo_{number}"]
            tcp, closes = demo["obs/robot0_eef_pos"][:], demo["actions"][:, 6]
            for t in range(REACH + CARRY):
                ahead = [k for k in range(t + 1, len(tcp)) if closes[k] != closes[k - 1]]
                offsets = [(closes[k], tcp[k] - tcp[t]) for k in ahead]
                first += offsets[:1] if number == 7 else []
                for command, offset in offsets if number < 7 else []:
                    known[command].append(offset)
    mean = {command: np.mean(offsets, axis=0) for command, offsets in known.items()}
    expected = np.median([np.linalg.norm(offset - mean[command]) for command, offset in first])
    assert found["baseline_m"] == pytest.approx(expected, abs=2e-5)
    assert found["episodes"] == 1
