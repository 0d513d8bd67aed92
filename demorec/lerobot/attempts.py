"""One row for every attempt that an export saw, failed ones too, from which success rates are told."""

from __future__ import annotations

from dataclasses import dataclass

import pyarrow as pa

from demorec.recording import AnyRecording, CollectedRecording, Recording
from demorec.scene.episode import Outcome

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


@dataclass(frozen=True, kw_only=True, eq=False)
class AttemptRecord:
    """One attempt, as far as success rates need it; positions in the world frame, metres, at the start.

    `success` is None where nobody said: of a collected episode.
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
        if isinstance(recording, CollectedRecording):
            return cls._of_collected(recording)
        info, outcome = recording.info, outcome_of(recording)
        name, object_position, goal_position = "", (None, None), (None, None)
        if info.scene.goals:
            goal = info.scene.goals[0]
            name = goal.object
            x, y, _ = info.scene.body(goal.object).world_from_body.position.tolist()
            object_position = (x, y)
            x, y, _ = info.scene.world_from_goal(goal).position.tolist()
            goal_position = (x, y)
        return cls(
            source=recording.path.name,
            run_episode_index=info.episode_index,
            attempt=info.attempt,
            success=outcome.success,
            failure_phase=outcome.failure_phase,
            failure_reason=outcome.failure_reason,
            object=name,
            object_x=object_position[0],
            object_y=object_position[1],
            goal_x=goal_position[0],
            goal_y=goal_position[1],
        )

    @classmethod
    def _of_collected(cls, recording: CollectedRecording) -> AttemptRecord:
        outcome = recording.outcome
        return cls(
            source=recording.path.name,
            run_episode_index=recording.info.episode_index,
            attempt=0,
            success=None if outcome is None else outcome.success,
            failure_phase="",
            failure_reason="cut off by a crash" if outcome is None else outcome.reason,
            object="",
            object_x=None,
            object_y=None,
            goal_x=None,
            goal_y=None,
        )


def outcome_of(recording: Recording) -> Outcome:
    """That of the recording; one that a crash cut off counts as failed."""
    return recording.outcome or Outcome(
        success=False, checks=(), failure_reason="interrupted", num_frames=recording.num_frames
    )
