"""Comparison of a finished dataset, read by the installed LeRobot, with the recordings.

Only LeRobot locates the rows, files and images. It runs in a separate process, because it loads PyTorch (seconds,
hundreds of megabytes) and caches copies of the tables, here in a temporary folder.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import tempfile
from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.errors import DemorecError, ExportError, describe_error, resource_error
from demorec.core.processes import SPAWN, exit_silently
from demorec.datasets.episode import ExportCamera
from demorec.datasets.lerobot.depth import DepthScale, quantised
from demorec.datasets.lerobot.language import EVENTS, PERSISTENT
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.prepare import LeRobotEpisode, export_episode, language_of, reason_to_transcode
from demorec.mcap import open_recording

LEROBOT = "lerobot[dataset]>=0.6.1,<0.7"
"""Requirement for a verification; a test compares it with pyproject.toml."""

MAX_EPISODES = 500
"""Maximum number of episodes from which samples are taken, evenly spaced."""

_TRANSCODED_TOLERANCE = 12.0
"""Maximum mean absolute difference of a transcoded image, in levels (0..255); others must be equal."""
_DEPTH_TOLERANCE = 6e-4
"""Metres; LeRobot rounds depth to millimetres."""

_GRACE_S = 5.0
"""Maximum time for the process to end by itself."""


def lerobot_is_installed() -> bool:
    """Whether LeRobot is installed; does not load it."""
    return importlib.util.find_spec("lerobot") is not None


class Verifier(AbstractContextManager["Verifier"]):
    """Context manager of the verification process, which loads LeRobot while the export runs.

    Leaving the context ends the process in any state: with too little memory, loading may never end.
    """

    def __init__(self) -> None:
        self._cache = tempfile.TemporaryDirectory(prefix="demorec-verify-")
        self._pipe, theirs = SPAWN.Pipe()
        self._process = SPAWN.Process(target=_serve, args=(theirs, self._cache.name), daemon=True)
        self._process.start()
        theirs.close()  # otherwise the pipe would never report that the process has ended

    def __exit__(self, kind: type[BaseException] | None, *exc: object) -> None:
        self._pipe.close()
        if kind is not None:
            self._process.terminate()
        self._process.join(timeout=_GRACE_S)
        self._process.kill()
        self._process.join()
        self._cache.cleanup()

    def verify(self, root: Path, samples: Sequence[tuple[int, Path]], options: ExportOptions) -> int:
        """Compare episodes with their recordings; return the number of frames compared. Raises ExportError if LeRobot
        cannot open the dataset, or reads values that differ from the recordings.
        """
        try:
            self._pipe.send((root, tuple(samples), options))
            found = self._pipe.recv()
        except (EOFError, OSError) as error:
            self._process.join()
            raise ExportError(
                f"The new dataset was dropped: the verification process ended unexpectedly (exit code "
                f"{self._process.exitcode}), often for lack of memory; free some, or give --no-verify."
            ) from error
        if isinstance(found, DemorecError):
            raise found
        return int(found)


def _serve(pipe: Connection[Any, Any], cache: str) -> None:
    signal.signal(signal.SIGTERM, exit_silently)  # an orderly end: libraries left semaphores
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the exporting process ends this one
    os.environ.update(HF_HUB_OFFLINE="1", HF_DATASETS_OFFLINE="1", HF_DATASETS_CACHE=cache)
    answer: int | DemorecError
    try:
        import lerobot.datasets  # noqa: F401

        root, samples, options = pipe.recv()
        answer = _verify(root, samples, options)
    except EOFError:
        return  # the export has ended without a dataset
    except DemorecError as error:
        answer = error
    except Exception as error:
        answer = resource_error(error) or ExportError(
            f"The new dataset was dropped, it cannot be verified ({describe_error(error)})."
        )
    with suppress(OSError):
        pipe.send(answer)


def _verify(root: Path, samples: Sequence[tuple[int, Path]], options: ExportOptions) -> int:
    from lerobot.datasets import LeRobotDataset

    try:
        dataset = LeRobotDataset(options.repo_id, root=root, video_backend="pyav", return_uint8=True)
    except Exception as error:  # on any error of LeRobot, the dataset is dropped
        raise resource_error(error) or ExportError(
            f"The new dataset was dropped, LeRobot cannot open it ({describe_error(error)})."
        ) from error
    frames = 0
    for number, (episode_index, path) in enumerate(samples):
        with open_recording(path) as recording:
            frames += _compare_episode(dataset, episode_index, export_episode(recording, options), number)
    return frames


def _compare_episode(dataset: Any, episode_index: int, episode: LeRobotEpisode, number: int) -> int:
    first = int(dataset.meta.episodes[episode_index]["dataset_from_index"])
    length = episode.num_frames
    # The last frame, where offsets accumulate, and another one that varies between episodes.
    moments = sorted({(number * 37) % length, length - 1})
    language = language_of(episode)
    for moment in moments:
        try:
            item = dataset[first + moment]
        except Exception as error:
            raise ExportError(
                f"The new dataset was dropped, LeRobot cannot read frame {moment} of episode {episode_index} "
                f"({describe_error(error)})."
            ) from error
        wrong = [
            name
            for name, values in episode.columns.items()
            if name in item and not np.array_equal(np.ravel(item[name]), np.ravel(values[moment]))
        ]
        said = {PERSISTENT: language.persistent, EVENTS: language.events.get(moment, ())}
        wrong += [name for name, expected in said.items() if name in item and item[name] != list(expected)]
        if item["task"] != episode.info.instruction:
            wrong.append("task")
        if float(item["timestamp"]) != float(np.float32(moment / dataset.meta.fps)):
            wrong.append("timestamp")
        wrong += [
            camera.feature
            for camera in episode.cameras
            if camera.feature in item and _is_wrong_image(item[camera.feature], episode, camera, moment)
        ]
        if wrong:
            raise ExportError(
                f"The new dataset was dropped: read through LeRobot, {', '.join(wrong)} of frame {moment} of episode "
                f"{episode_index} differ from the recording: {episode.recording.path}"
            )
    return len(moments)


def _is_wrong_image(tensor: Any, episode: LeRobotEpisode, camera: ExportCamera, moment: int) -> bool:
    """Whether an image differs from the recorded one; for depth, by more than the resolution of its codes."""
    number, recording = int(episode.numbers(camera)[moment]), episode.recording
    if camera.is_depth:
        recorded = next(islice(recording.depth(camera.name), number, None))
        metres = tensor.numpy().reshape(recorded.shape) / 1000
        return bool(np.abs(metres - DepthScale().values()[quantised(recorded)]).max() > _DEPTH_TOLERANCE)
    limit = _TRANSCODED_TOLERANCE if reason_to_transcode(episode, camera) else 0.0
    found = tensor.numpy().transpose(1, 2, 0).astype(np.float64)
    return bool(np.abs(found - recording.numbered_image(camera.name, number)).mean() > limit)
