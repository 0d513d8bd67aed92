"""Episodes of datasets that were made of collected episodes: what a dataset keeps of them, to be played."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.geometry import Array
from demorec.lerobot.layout import AUTOMATIC_FEATURES, DatasetInfo
from demorec.lerobot.reader import read_tasks
from demorec.lerobot.robots import DatasetRobot
from demorec.plain import from_json
from demorec.playback.episode import Curves, Depth, PlayedCollected, Statements, Video
from demorec.recording.collected.transforms import JointPositions
from demorec.scene.collected import CollectedCamera, CollectedFeature, CollectedInfo, CollectedOutcome, Origin

_TASK, _DONE = "task_index", "next.done"


def collected_of_dataset(
    root: Path,
    row: Mapping[str, Any],
    described: DatasetInfo,
    data: Mapping[str, Array],
    time_ns: NDArray[np.int64],
    videos: Mapping[str, Video],
    depth: Mapping[str, Depth],
    robot: DatasetRobot | None,
    statements: Statements,
) -> PlayedCollected:
    """An episode as its dataset knows it, at the dataset's rate.

    Args:
        root: The dataset's folder.
        row: Of the episode, in the sidecar.
        described: info.json.
        data: Feature -> (T, D) of the episode's rows.
        time_ns: (T,) of the rows.
        videos: Camera -> coded pictures.
        depth: Depth camera -> reads (time_ns, (H, W) metres) of every row.
        robot: The arm, if it is known.
        statements: What is said of the episode.

    Raises:
        RecordingError, ExportError, ValueError, KeyError, TypeError: Its tables hold something odd.
    """
    number, num_frames = int(row["episode_index"]), len(time_ns)
    names = {
        name: described.features[name].names or tuple(str(index) for index in range(values.shape[1]))
        for name, values in data.items()
        if name not in AUTOMATIC_FEATURES and name != _DONE
    }
    tasks = read_tasks(root)
    joints, units = ({}, {}) if robot is None else (robot.record.joints, robot.record.units)
    features = tuple(
        CollectedFeature(
            name=name, dtype="float32", names=parts, joints=joints.get(name, ()), units=units.get(name, ())
        )
        for name, parts in names.items()
    )
    positions = JointPositions(features)
    values = positions.of(data).T if positions.joints else ()
    return PlayedCollected(
        name=f"episode_{number:06d}",
        group=root.resolve().name,
        identity=hashlib.sha256(f"{root.resolve()} {number}".encode()).hexdigest()[:16],
        source=str(row["source"]),
        info=CollectedInfo(
            episode_index=number,
            instruction=tasks[int(data[_TASK][0, 0])] if num_frames else "",
            robot=described.robot_type or "",
            fps=int(described.fps),
            urdf="" if robot is None else robot.urdf,
            features=features,
            cameras=tuple(
                CollectedCamera(name=camera["name"], width=camera["width"], height=camera["height"])
                for camera in row["cameras"]
                if camera["name"] in videos or camera["name"] in depth
            ),
            origin=from_json(row["origin"], Origin),
        ),
        outcome=CollectedOutcome(success=row["success"], num_frames=num_frames, reason=row["failure_reason"]),
        time_ns=time_ns,
        joint_position=dict(zip(positions.joints, values, strict=True)),
        curves={name: Curves(time_ns=time_ns, values=data[name], names=parts) for name, parts in names.items()},
        videos=videos,
        depth=depth,
        statements=statements,
    )
