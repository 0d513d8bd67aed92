"""The sidecar: data without a place in LeRobot's format, in the folder `demorec/` of the dataset.

- `episodes/`: one row per episode: its source (run's episode number, attempt, seed, config digest), its outcome (every
  check with value and limit), phases, cameras with intrinsics and extrinsics, final poses of objects, and
  `episode_info`: the complete description of scene and robot as JSON, from which `demorec` can rebuild the world.
- `robots/`: the arms as URDFs (`demorec.datasets.lerobot.robots`).
- `configs.json`: config digest -> resolved configuration; `export.json`: options of the export.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from demorec.core.files import Closing
from demorec.core.plain import to_json, to_plain
from demorec.datasets.lerobot.files import write_text
from demorec.datasets.lerobot.layout import SIDECAR_EPISODES_PATH, DatasetInfo
from demorec.datasets.lerobot.parquet import RollingParquet
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.robots import DatasetRobot, robot_of, write_robot
from demorec.episode.episode import Outcome, consecutive_runs

if TYPE_CHECKING:
    from demorec.datasets.episode import ExportEpisode
    from demorec.episode.info import Camera, Simulation

CONFIGS_PATH = f"{SIDECAR_DIR}/configs.json"
EXPORT_PATH = f"{SIDECAR_DIR}/export.json"

_TEXT, _WHOLE, _NUMBER, _FLAG = pa.string(), pa.int64(), pa.float64(), pa.bool_()
_VECTOR = pa.list_(_NUMBER)
_CHECK = pa.struct({"name": _TEXT, "value": _NUMBER, "limit": _NUMBER, "unit": _TEXT, "passed": _FLAG})
_PHASE = pa.struct({"name": _TEXT, "from": _WHOLE, "to": _WHOLE})
_OBJECT = pa.struct({"name": _TEXT, "world_from_object_end": _VECTOR})
_CAMERA = pa.struct(
    {
        "name": _TEXT,
        "width": _WHOLE,
        "height": _WHOLE,
        "intrinsics": _VECTOR,
        "mount": _TEXT,
        "mount_from_camera": _VECTOR,
    }
)

EPISODE_SCHEMA = pa.schema(
    {
        "episode_index": _WHOLE,
        "source": _TEXT,
        "run_episode_index": _WHOLE,
        "attempt": _WHOLE,
        "root_seed": pa.uint64(),
        "origin": _TEXT,
        "config_digest": _TEXT,
        "content_digest": _TEXT,
        "success": _FLAG,
        "failure_phase": _TEXT,
        "failure_reason": _TEXT,
        "num_retries": _WHOLE,
        "final_state_digest": _TEXT,
        "checks": pa.list_(_CHECK),
        "phases": pa.list_(_PHASE),
        "objects": pa.list_(_OBJECT),
        "cameras": pa.list_(_CAMERA),
        "episode_info": _TEXT,
        "robot_digest": _TEXT,
    }
)


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeRecord:
    """The sidecar's data about one episode of the dataset.

    Attributes:
        row: Row of the table of episodes, without the index.
        config: Configuration of the run.
        robot: The arm; None if unknown.
    """

    row: Mapping[str, Any]
    config: Mapping[str, Any] = field(default_factory=dict)
    robot: DatasetRobot | None = None

    @classmethod
    def of(cls, episode: ExportEpisode[Any]) -> EpisodeRecord:
        """Describe an episode; frame numbers are those of the dataset."""
        info, recording, simulation = episode.info, episode.recording, episode.info.simulation
        outcome, robot = recording.outcome, robot_of(episode)
        row = {
            "source": recording.path.name,
            "run_episode_index": info.episode_index,
            "attempt": info.attempt,
            "success": recording.success,
            "failure_reason": "cut off by a crash" if outcome is None else outcome.failure_reason,
            "origin": info.origin if isinstance(info.origin, str) else to_json(info.origin),
            "cameras": [_described_camera(camera) for camera in info.cameras],
            "robot_digest": None if robot is None else robot.digest,
        }
        if simulation is None:
            return cls(row=row, robot=robot)
        return cls(row=row | _simulated_row(simulation, episode), config=simulation.config, robot=robot)


def _simulated_row(simulation: Simulation, episode: ExportEpisode[Any]) -> dict[str, Any]:
    """Return the columns that need a simulation; a truncated recording has no outcome."""
    trajectory, recording = episode.recording.trajectory(), episode.recording
    outcome = recording.outcome or Outcome(num_frames=recording.num_frames)
    return {
        "root_seed": simulation.root_seed,
        "config_digest": simulation.config_digest,
        "failure_phase": outcome.failure_phase,
        "num_retries": outcome.num_retries,
        "final_state_digest": outcome.final_state_digest,
        "checks": [to_plain(check) for check in outcome.checks],
        "phases": [{"name": name, "from": first, "to": end} for name, first, end in consecutive_runs(trajectory.phase)],
        "objects": [
            {"name": name, "world_from_object_end": poses[-1].tolist()}
            for name, poses in trajectory.object_poses.items()
        ],
        "episode_info": to_json(episode.info),
    }


def _described_camera(camera: Camera) -> dict[str, Any]:
    intrinsics = camera.intrinsics
    placed = camera.mount_from_camera
    return {
        "name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "intrinsics": None if intrinsics is None else list(intrinsics),
        "mount": camera.mount or None,
        "mount_from_camera": None if placed is None else placed.vector().tolist(),
    }


class SidecarWriter(Closing):
    """Context manager that writes the sidecar episode by episode; `finish` completes it.

    Args:
        root: Folder of the dataset; an existing sidecar is continued.
        configs: Config digest -> configuration, of the existing episodes.
    """

    def __init__(self, root: Path, info: DatasetInfo, configs: Mapping[str, Any]) -> None:
        self._root = root
        self._episodes = RollingParquet(root, SIDECAR_EPISODES_PATH, EPISODE_SCHEMA, info, compression="zstd")
        self._configs: dict[str, Any] = dict(configs)

    def close(self) -> None:
        """Close the table without completing it."""
        self._episodes.abort()

    def add(self, episode_index: int, digest: str, record: EpisodeRecord) -> None:
        """Add an episode of the dataset and its digest."""
        self._episodes.add_row({**record.row, "episode_index": episode_index, "content_digest": digest})
        if record.robot is not None:
            write_robot(self._root, record.robot)
        if record.config:
            self._configs.setdefault(record.row["config_digest"], record.config)

    def finish(self, export: Mapping[str, Any]) -> None:
        """Close the table and write the two JSON files."""
        self._episodes.close()
        write_text(self._root / CONFIGS_PATH, json.dumps(self._configs, indent=2, sort_keys=True) + "\n")
        write_text(self._root / EXPORT_PATH, json.dumps(dict(export), indent=2, sort_keys=True) + "\n")
