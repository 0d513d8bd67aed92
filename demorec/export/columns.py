"""The numbers of a recording as every exporter writes them: which frames, which features."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.errors import ConfigError, ExportError
from demorec.export.options import CommonOptions
from demorec.recording import Recording
from demorec.registry import nearest_match
from demorec.scene.episode import EpisodeColumns, interventions
from demorec.scene.features import (
    ACTION,
    DEPTH_SUFFIX,
    ENVIRONMENT_STATE,
    IMAGE_PREFIX,
    ObservationRows,
    StateKind,
    VectorType,
    action_vectors,
    observation_vectors,
)

REWARD, DONE, SUCCESS = "next.reward", "next.done", "next.success"
INTERVENTION = "intervention"
"""As LeRobot's DAgger calls it: whether the expert acts in an episode that a policy began."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureColumns:
    """The numbers of one recording, ready to be written.

    Attributes:
        recorded: All of its numbers, every frame.
        rows: (T,) which of these frames the dataset has.
        features: Feature -> (T, D); (T,) float32 for REWARD, (T,) bool for DONE, SUCCESS and INTERVENTION.
    """

    recorded: EpisodeColumns
    rows: NDArray[np.intp]
    features: Mapping[str, NDArray[np.generic]]


def frame_stride(recording_fps: int, fps: int | None) -> int:
    """How many frames of the recording make one of the dataset.

    Raises:
        ConfigError: The wanted fps does not divide that of the recording.
    """
    if fps is None:
        return 1
    if recording_fps % fps:
        divisors = [str(n) for n in range(1, recording_fps + 1) if recording_fps % n == 0]
        raise ConfigError(
            f"fps is {fps}, which does not divide the recordings' {recording_fps}: allowed are {', '.join(divisors)}."
        )
    return recording_fps // fps


def check_feature_names(options: CommonOptions, offered: Collection[str]) -> None:
    """Raise ConfigError when `options.features` names one that is not among the offered ones."""
    for name in options.features:
        if name == ENVIRONMENT_STATE and name not in offered:
            raise ConfigError(f"The feature {name} is named in --features, but only --privileged adds it.")
        if name not in offered:
            raise ConfigError(
                f"Unknown feature {name!r}.{nearest_match(name, offered)} The recordings and these options give: "
                f"{', '.join(offered)}."
            )


def feature_columns(
    recording: Recording, options: CommonOptions, *, state: StateKind = "joint", dtype: VectorType = np.float32
) -> FeatureColumns:
    """All numbers that recordings and options give, whichever of them `options.features` names, vectors as `dtype`.

    With frames left out, an observation is that of the first frame of its group and an action the last one of it:
    where the robot shall be when the next observation is taken.

    Raises:
        ConfigError: The options ask for depth pictures that were not recorded.
        ExportError: The recording has no frames, or a value that is not finite, with which no policy can be trained.
        RecordingError: It is damaged.
    """
    info = recording.info
    for camera in recording.cameras if options.depth else ():
        if options.takes(IMAGE_PREFIX + camera + DEPTH_SUFFIX) and not recording.has_depth(camera):
            raise ConfigError(
                f"--depth needs recordings with depth pictures (generate --depth), and the camera {camera!r} has none: "
                f"leave it out: {recording.path}"
            )
    if recording.num_frames == 0:
        raise ExportError(f"The recording has no frames: {recording.path}")
    stride = frame_stride(info.fps, options.fps)
    columns = recording.columns()
    rows = np.arange(0, recording.num_frames, stride)
    action_rows = np.minimum(rows + stride - 1, recording.num_frames - 1)
    features: dict[str, NDArray[np.generic]] = dict(
        observation_vectors(
            ObservationRows.of_columns(columns, rows),
            info.robot,
            info.scene,
            privileged=options.privileged,
            state=state,
            dtype=dtype,
        )
    )
    features[ACTION] = action_vectors(columns, info.scene, options.action, action_rows, dtype=dtype)
    for name, values in features.items():
        if len(wrong := np.flatnonzero(~np.isfinite(values.astype(np.float64)).all(axis=1))):
            raise ExportError(
                f"The feature {name} is not finite in frame {int(rows[wrong[0]])}, leave the recording out: "
                f"{recording.path}"
            )
    success = recording.outcome is not None and recording.outcome.success
    is_last = rows == rows[-1]
    features[REWARD] = (is_last & success).astype(np.float32)
    features[DONE] = is_last
    features[SUCCESS] = is_last & success
    features[INTERVENTION] = interventions(columns.phase)[rows]
    return FeatureColumns(recorded=columns, rows=rows, features=features)
