"""LeRobot datasets become runs: every episode a recording, its numbers bit-exact, its packets byte for byte.

The same command again goes on: episodes that are there are not written.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, ExportError
from demorec.core.files import sha256_of
from demorec.datasets.lerobot.episodes import LeRobotDataset
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.datasets.lerobot.recording import DatasetRecording
from demorec.datasets.lerobot.videos import why_transcoded
from demorec.episode.info import Camera, EpisodeInfo, Origin, SourceFile
from demorec.episode.roles import NO_NAMES, NamedRoles
from demorec.robots.motors import Motors
from demorec.runs.external import episode_path, open_external_run, planned_episode
from demorec.runs.find import expect
from demorec.sources.frames_writer import FramesImport, Image, importing_versions, write_frames


def import_lerobot(
    roots: Sequence[Path],
    mapping: Path | None,
    out: Path,
    *,
    video: VideoConfig | None = None,
    motors: Motors | None = None,
    named: NamedRoles = NO_NAMES,
) -> FramesImport:
    """Import a LeRobot dataset of format v3.0, v2.1 or v2.0, whoever wrote it, into a run.

    Args:
        roots: The dataset's folder, the only one.
        mapping: Unused: datasets need none.
        out: The run's folder; one that the same dataset began is continued.
        video: How images are encoded whose packets cannot pass through.
        motors: The servos whose values LeRobot recorded as state and action.
        named: Features whose role the user names; the recordings keep it.

    Raises:
        ConfigError: This is no dataset, not one of these servos, it has what no recording can hold, or the folder holds
            something else.
        ExportError: It is damaged, or not at its rate.
        RecordingError: A number is not finite, or the disk is full.
    """
    if len(roots) != 1:
        raise ConfigError(f"One dataset becomes one run, given are {len(roots)}: import them one by one.")
    root = roots[0]
    expect(root, "dataset")
    dataset = LeRobotDataset(root, motors, named)
    if elements := [name for name in named.gripper if name not in dataset.info.features]:
        raise ConfigError(f"An import takes whole features: --gripper names {elements[0]!r}, an element of the state.")
    if not dataset.places:
        raise ConfigError(f"The dataset has no episodes: {root}")
    if empty := [place.episode_index for place in dataset.places if place.length < 1]:
        raise ExportError(f"Episode {empty[0]} of the dataset has no frames: {root}")
    for name in list(dataset.inexact()):
        dataset.leave_out(name, "it has whole numbers that float64 cannot hold")
    cameras, fates = _cameras(dataset)
    digest, num_new = functools.cache(sha256_of), 0
    video = video or VideoConfig()
    with open_external_run(out, recovers=False) as folder:
        numbers = range(len(dataset.places))
        folder.planned = [planned_episode(n) for n in numbers if not episode_path(folder.path, n).exists()]
        for number in numbers:
            recording = DatasetRecording(dataset, number)
            info, subtasks = _info(recording, cameras, digest), dict(recording.subtasks)
            if folder.has(info):
                continue
            columns = recording.table()
            rows = range(recording.num_frames)
            frames = ({name: values[row] for name, values in columns.features.items()} for row in rows)
            images = {camera.name: _images(recording, camera) for camera in info.cameras}
            leads = {camera.name: int(columns.images[camera.name][0]) for camera in info.cameras if camera.kept}
            outcome = recording.outcome
            write_frames(folder, info, frames, images, outcome=outcome, video=video, leads=leads, subtasks=subtasks)
            num_new += 1
    return FramesImport(
        num_episodes=len(dataset.places),
        num_frames=sum(place.length for place in dataset.places),
        num_new=num_new,
        cameras=fates,
        left_out=dataset.left_out,
    )


def _cameras(dataset: LeRobotDataset) -> tuple[dict[str, Camera], dict[str, str]]:
    """The cameras as the recordings shall have them, and what becomes of the images of each, in words."""
    cameras, fates = {}, {}
    for name, key in dataset.keys.items():
        feature = dataset.info.features[key]
        cameras[name] = camera = dataset.camera(name)
        if feature.is_depth:
            next(DatasetRecording(dataset, 0).distances(name))
            fates[name] = "the distances of its codes, in metres (32FC1)"
        elif feature.is_video:
            codec, (width, height), reason = why_transcoded([dataset.video(key, place) for place in dataset.places])
            cameras[name] = replace(camera, width=width, height=height, kept="" if reason else codec)
            fates[name] = f"{codec}, encoded once, since {reason}" if reason else f"{codec}, passed through as it is"
        else:
            fates[name] = "images of their own, encoded once"
    return cameras, fates


def _info(recording: DatasetRecording, cameras: dict[str, Camera], digest: Callable[[Path], str]) -> EpisodeInfo:
    """What the recording shall say of an episode."""
    dataset, place = recording.dataset, recording.place
    videos = [place.videos[key][0] for key in dataset.keys.values() if key in place.videos]
    names = [INFO_PATH, *(path.relative_to(dataset.root).as_posix() for path in (place.data, *videos))]
    return replace(
        recording.info,
        cameras=tuple(replace(camera, kept=cameras[camera.name].kept) for camera in recording.info.cameras),
        origin=Origin(
            kind="import", files=tuple(SourceFile(name=name, sha256=digest(dataset.root / name)) for name in names)
        ),
        versions=importing_versions(),
    )


def _images(recording: DatasetRecording, camera: Camera) -> Iterator[Image]:
    """Of the camera's lead, where packets pass through, and of every frame."""
    if camera.is_depth:
        return recording.distances(camera.name)
    if camera.kept:
        return (packet.data for packet in recording.packets(camera.name))
    return islice(recording.images(camera.name), int(recording.table().images[camera.name][0]), None)
