"""Opens a finished dataset with the installed LeRobot and compares samples of it with the recordings.

Nothing of the writing code is used to read: LeRobot finds the rows, the files and the pictures by itself. It runs in
a process of its own, since LeRobot brings PyTorch (seconds to load, hundreds of megabytes) and keeps copies of the
tables in a cache, which here is a temporary folder.
"""

from __future__ import annotations

import importlib.util
import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from demorec.errors import ExportError
from demorec.export.depth import DEPTH_SUFFIX, code_values, quantised
from demorec.export.layout import IMAGE_PREFIX
from demorec.export.options import ExportOptions
from demorec.export.prepare import frame_stride, prepare_episode
from demorec.export.transcode import reason_to_transcode
from demorec.processes import SPAWN
from demorec.recording import Recording

LEROBOT = "lerobot[dataset]>=0.6.1,<0.7"
"""What pip has to install for a verification; a test compares it with pyproject.toml."""

MAX_EPISODES = 500
"""Samples are taken of so many episodes, spread evenly, if there are more."""

_TRANSCODED_TOLERANCE = 12.0
"""Mean absolute difference in levels (0..255) allowed of a picture that was coded anew; others must be equal."""
_DEPTH_TOLERANCE = 6e-4
"""Metres; LeRobot rounds distances to millimetres."""


def lerobot_is_installed() -> bool:
    """Whether there is a LeRobot that could verify; tells it without loading it."""
    return importlib.util.find_spec("lerobot") is not None


@dataclass(frozen=True, kw_only=True)
class Sample:
    """An episode of the dataset and the recording that it comes from."""

    episode_index: int
    recording: Path


class Verifier:
    """Context manager over the process that verifies; it starts loading LeRobot at once, while the export runs."""

    def __init__(self) -> None:
        self._cache = tempfile.TemporaryDirectory(prefix="demorec-verify-")
        self._pool = ProcessPoolExecutor(
            max_workers=1, mp_context=SPAWN, initializer=_prepare_process, initargs=(self._cache.name,)
        )
        self._loading: Future[None] = self._pool.submit(_load_lerobot)

    def __enter__(self) -> Verifier:
        return self

    def __exit__(self, *exc: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._cache.cleanup()

    def verify(self, root: Path, samples: Sequence[Sample], options: ExportOptions) -> int:
        """Compare; return how many frames were compared.

        Raises:
            ExportError: LeRobot cannot open the dataset, or shows something else than the recordings.
        """
        self._loading.result()
        return self._pool.submit(_verify, root, tuple(samples), options).result()


def _prepare_process(cache: str) -> None:
    os.environ.update(HF_HUB_OFFLINE="1", HF_DATASETS_OFFLINE="1", HF_DATASETS_CACHE=cache)


def _load_lerobot() -> None:
    import lerobot.datasets  # noqa: F401


def _verify(root: Path, samples: tuple[Sample, ...], options: ExportOptions) -> int:
    from lerobot.datasets import LeRobotDataset

    try:
        dataset = LeRobotDataset(options.repo_id, root=root, video_backend="pyav", return_uint8=True)
    except Exception as error:  # whatever LeRobot says, the dataset must not be handed out
        raise ExportError(
            f"The new dataset was dropped, LeRobot cannot open it ({type(error).__name__}: {error})."
        ) from error
    frames = 0
    for number, sample in enumerate(samples):
        with Recording(sample.recording) as recording:
            frames += _compare_episode(dataset, sample, recording, options, number)
    return frames


def _compare_episode(dataset: Any, sample: Sample, recording: Recording, options: ExportOptions, number: int) -> int:
    expected = prepare_episode(recording, options, code_depth=False).data
    stride = frame_stride(recording.info.fps, options.fps)
    first = int(dataset.meta.episodes[sample.episode_index]["dataset_from_index"])
    # The last frame, where offsets add up, and one more that differs from episode to episode.
    moments = sorted({(number * 37) % expected.num_frames, expected.num_frames - 1})
    for moment in moments:
        try:
            item = dataset[first + moment]
        except Exception as error:
            raise ExportError(
                f"The new dataset was dropped, LeRobot cannot read frame {moment} of episode {sample.episode_index} "
                f"({type(error).__name__}: {error})."
            ) from error
        wrong = [
            name for name, values in expected.columns.items() if name in item and not _equal(item[name], values[moment])
        ]
        if item["task"] != expected.task:
            wrong.append("task")
        if float(item["timestamp"]) != float(np.float32(moment / dataset.meta.fps)):
            wrong.append("timestamp")
        for camera in recording.cameras:
            wrong += _wrong_pictures(item, recording, camera, moment, stride)
        if wrong:
            raise ExportError(
                f"The new dataset was dropped: read through LeRobot, {', '.join(wrong)} of frame {moment} of episode "
                f"{sample.episode_index} differ from the recording: {sample.recording}"
            )
    return len(moments)


def _equal(tensor: Any, values: Any) -> bool:
    found = np.asarray(tensor)
    return bool(np.array_equal(found.reshape(-1), np.asarray(values).reshape(-1)))


def _wrong_pictures(item: Any, recording: Recording, camera: str, moment: int, stride: int) -> list[str]:
    wrong = []
    key = IMAGE_PREFIX + camera
    if key in item:
        settings = recording.video_settings(camera)
        found = item[key].numpy().transpose(1, 2, 0).astype(np.float64)
        limit = _TRANSCODED_TOLERANCE if reason_to_transcode(settings, stride) else 0.0
        if np.abs(found - recording.image(camera, moment * stride)).mean() > limit:
            wrong.append(key)
    if key + DEPTH_SUFFIX in item:
        found = item[key + DEPTH_SUFFIX].numpy()
        found = found.reshape(found.shape[-2:]) / 1000  # LeRobot gives millimetres
        recorded = next(islice(recording.depth(camera), moment * stride, None))
        if np.abs(found - code_values()[quantised(recorded)]).max() > _DEPTH_TOLERANCE:
            wrong.append(key + DEPTH_SUFFIX)
    return wrong
