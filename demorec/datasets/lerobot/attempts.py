"""One row for every attempt that an export saw, failed ones too, from which success rates are told."""

from __future__ import annotations

from dataclasses import dataclass

import pyarrow as pa

from demorec.mcap import AnyRecording

ATTEMPT_SCHEMA = pa.schema(
    [
        ("source", pa.string()),
        ("run_episode_index", pa.int64()),
        ("attempt", pa.int64()),
        ("success", pa.bool_()),
        ("failure_phase", pa.string()),
        ("failure_reason", pa.string()),
        ("object", pa.string()),
        ("object_x", pa.float64()),
        ("object_y", pa.float64()),
        ("goal_x", pa.float64()),
        ("goal_y", pa.float64()),
        ("in_dataset", pa.bool_()),
    ]
)


CUT_OFF = "cut off by a crash"
"""Reason of a failure that nobody was there to state."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AttemptRecord:
    """One attempt, as far as success rates need it; positions in the world frame, metres, at the start.

    `success` is None where nobody said.
    """

    source: str
    run_episode_index: int
    attempt: int
    success: bool | None
    failure_phase: str
    failure_reason: str
    object: str
    object_x: float | None
    object_y: float | None
    goal_x: float | None
    goal_y: float | None

    @classmethod
    def of(cls, recording: AnyRecording) -> AttemptRecord:
        """From the recording's metadata alone."""
        info, outcome, scene = recording.info, recording.outcome, recording.info.scene
        name = ""
        place: list[float | None] = [None] * 4
        if scene is not None and scene.goals:
            name = scene.goals[0].object
            poses = (scene.body(name).world_from_body, scene.world_from_goal(scene.goals[0]))
            place = [value for pose in poses for value in pose.position[:2].tolist()]
        object_x, object_y, goal_x, goal_y = place
        return cls(
            source=recording.path.name,
            run_episode_index=info.episode_index,
            attempt=info.attempt,
            success=recording.success,
            failure_phase="" if outcome is None else outcome.failure_phase,
            failure_reason=CUT_OFF if outcome is None else outcome.failure_reason,
            object=name,
            object_x=object_x,
            object_y=object_y,
            goal_x=goal_x,
            goal_y=goal_y,
        )
