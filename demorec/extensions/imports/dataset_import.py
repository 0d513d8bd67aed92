"""Import of LeRobot datasets to runs: one recording per episode, with bit-exact numbers and packets.

The same command continues: existing episodes are not written again.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, ExportError, RecordingError, resource_error
from demorec.core.files import sha256_of
from demorec.datasets.lerobot.language import PERSISTENT
from demorec.datasets.lerobot.paths import BOXES_DIR, INFO_PATH, PROGRESS_PATH, SIDECAR_DIR
from demorec.datasets.options import select_episodes
from demorec.episode.info import Camera, EpisodeInfo, Origin, SourceFile
from demorec.episode.roles import NO_NAMES, NamedRoles
from demorec.extensions.datasets.dataset_features import NOT_HELD, is_task_reference, why_not_recorded
from demorec.extensions.datasets.episode_places import EpisodePlace
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import mistyped_features
from demorec.extensions.datasets.recording import DatasetRecording
from demorec.extensions.imports.description import importing_versions
from demorec.extensions.imports.episode_writer import FramesImport, Image, add_episode
from demorec.extensions.recorder.external_run import ExternalFolder, episode_path, open_external_run, planned_episode
from demorec.mcap.video import deep_gray
from demorec.robots.motors import Motors
from demorec.runs.find import expect

_MAX_EXACT = 2**53
"""Maximum integer up to which float64 is exact."""


def import_lerobot(
    roots: Sequence[Path],
    mapping: Path | None,
    out: Path,
    *,
    video: VideoConfig | None = None,
    motors: Motors | None = None,
    named: NamedRoles = NO_NAMES,
    episodes: str = "",
    skip_bad: bool = False,
) -> FramesImport:
    """Import a LeRobot dataset of format v3.0, v2.1 or v2.0, from any writer, to a run.

    Args:
        roots: The dataset's folder, exactly one.
        mapping: Unused: datasets need none.
        out: The run's folder; a run started from the same dataset is continued.
        video: Encoding of images with packets that cannot pass through.
        motors: Servos whose values LeRobot recorded as state and action.
        named: Features whose role the user names; the recordings keep it.
        episodes: Episodes to import, as in `select_episodes`.
        skip_bad: Leave out episodes that cannot be read; otherwise the first of them ends the import.

    Raises:
        ConfigError: This is not a dataset, not one of these servos or none of its episodes, it has data that
        recordings cannot hold, or the folder holds other files.
        ExportError: It is damaged, or its timestamps do not match its rate.
        RecordingError: A number is not finite, or the disk is full.
    """
    dataset = _opened(roots, motors, named)
    left_out = _left_out(dataset)
    skipped: dict[int, str] = {}
    noted = skipped if skip_bad else None
    numbers = sorted(set(select_episodes(range(len(dataset.places)), episodes)))
    chosen = [(number, dataset.places[number]) for number in numbers]
    survey = _surveyed(dataset, [place for _, place in chosen], noted)
    left_out |= _leave_out_unkept(dataset, survey)
    cameras, fates = _cameras(dataset, survey)
    digest, num_new, num_frames = functools.cache(sha256_of), 0, 0
    with open_external_run(out, recovers=False) as folder:
        indices = [place.episode_index for _, place in chosen if place.episode_index not in skipped]
        folder.planned = [planned_episode(n) for n in indices if not episode_path(folder.path, n).exists()]
        for number, place in chosen:
            if place.episode_index in skipped:
                continue
            with _reading(place, noted):
                recording = DatasetRecording(dataset, number)
                num_new += _write(recording, cameras, folder, video or VideoConfig(), digest)
                num_frames += place.length
                if recording.language_left_out:
                    left_out[PERSISTENT] = recording.language_left_out
    return FramesImport(
        num_episodes=len(chosen) - len(skipped),
        num_frames=num_frames,
        num_new=num_new,
        cameras=fates,
        left_out=left_out,
        skipped={f"episode {index}": reason for index, reason in skipped.items()},
        notes=(*dataset.notes, *_rounded(dataset)),
    )


def _leave_out_unkept(dataset: LeRobotFolder, survey: _Survey) -> dict[str, str]:
    """Leave out features whose values a recording or its export would not keep; returns each with the reason."""
    unkept = dict.fromkeys(survey.inexact, "it has whole numbers that float64 cannot hold")
    unkept |= {
        name: "it may refer to tasks by number, and an export of the run numbers them again"
        for name, feature in dataset.info.features.items()
        if is_task_reference(name, feature)
    }
    for name in unkept:
        dataset.leave_out(name)
    return unkept


def _opened(roots: Sequence[Path], motors: Motors | None, named: NamedRoles) -> LeRobotFolder:
    if len(roots) != 1:
        raise ConfigError(f"One dataset becomes one run, found {len(roots)}: import them one by one.")
    root = roots[0]
    expect(root, "dataset")
    dataset = LeRobotFolder(root, motors, named)
    state = dataset.roles.elements(dataset.roles.state)  # ConfigError if a named feature is missing
    if parts := [name for name in named.gripper if name in state and name not in dataset.info.features]:
        raise ConfigError(f"An import takes whole features: --gripper names {parts[0]!r}, an element of the state.")
    if not dataset.places:
        raise ConfigError(f"The dataset has no episodes: {root}")
    return dataset


@contextmanager
def _reading(place: EpisodePlace, skipped: dict[int, str] | None) -> Iterator[None]:
    """Collect the reason why an episode cannot be read; if `skipped` is None, raise it."""
    try:
        yield
    except (ExportError, RecordingError) as error:
        if skipped is None or resource_error(error) is not None:
            raise
        skipped[place.episode_index] = str(error)


@dataclass(kw_only=True)
class _Survey:
    """Common properties of the readable episodes."""

    inexact: set[str] = field(default_factory=set)
    """Features with integers that float64 cannot hold."""
    formats: dict[str, set[tuple[str, tuple[int, int]]]] = field(default_factory=dict)
    """Video camera -> (codec, (width, height)) of its files."""
    reasons: dict[str, str] = field(default_factory=dict)
    """Video camera -> reason why its packets cannot pass through."""


def _surveyed(dataset: LeRobotFolder, places: Sequence[EpisodePlace], skipped: dict[int, str] | None) -> _Survey:
    """Check the integers and the encoded images of these episodes."""
    survey = _Survey()
    types = {feature.name: dataset.info.features[feature.name].dtype for feature in dataset.features}
    whole = [name for name, dtype in types.items() if dtype in ("int64", "uint64")]
    rows = dataset.rows(whole)
    for place in places:
        with _reading(place, skipped):
            if place.length < 1:
                raise ExportError(f"Episode {place.episode_index} of the dataset has no frames: {dataset.root}")
            numbers = rows.numbers(place) if whole else {}
            for name, key in dataset.keys.items():
                feature = dataset.info.features[key]
                if feature.is_video and not feature.is_depth:
                    video = dataset.video(key, place)
                    if measurement := deep_gray(video.file.codec, video.file.pixels, video.file.parameters):
                        raise ConfigError(
                            f"The video of {key} holds {measurement}, which is depth or another measurement and "
                            f"not colour, and {INFO_PATH} has no scale of it: leave it out (demorec dataset "
                            f"drop-features DATASET {key} --out NEW): {video.path}"
                        )
                    survey.formats.setdefault(name, set()).add((video.file.codec_name, video.file.size))
                    survey.reasons[name] = survey.reasons.get(name) or video.why_transcoded()
            survey.inexact |= {name for name in whole if (abs(numbers[name]) > _MAX_EXACT).any()}
    return survey


def _left_out(dataset: LeRobotFolder) -> dict[str, str]:
    """Name in the dataset -> reason why recordings cannot hold it."""
    features = dataset.info.features.items()
    found = {name: reason for name, feature in features if (reason := why_not_recorded(name, feature))}
    if dataset.language_rows is not None:
        found.pop(PERSISTENT)
    found |= {name: NOT_HELD for name in (BOXES_DIR, PROGRESS_PATH) if (dataset.root / name).exists()}
    if not dataset.has_one_robot:
        found[f"{SIDECAR_DIR}/robots"] = "not all episodes have the same robot there, as those of a run have"
    if any(row["root_seed"] is not None for row in dataset.known.values()):
        found[f"{SIDECAR_DIR}/episodes"] = "scenes, phases and conditions of success are not read back"
    return found


def _rounded(dataset: LeRobotFolder) -> Iterator[str]:
    """Name the features that are read as float32, as LeRobot does, from more precise numbers."""
    imported = {feature.name for feature in dataset.features}
    found: Mapping[str, str] = {}
    with suppress(ExportError):  # an unreadable file is reported for its own episodes
        found = mistyped_features(dataset)
    for name, stored in found.items():
        if name in imported and stored == "float64" and dataset.info.features[name].dtype == "float32":
            yield f"{name} is rounded to float32, its type in info.json; the data files hold float64."


def _cameras(dataset: LeRobotFolder, survey: _Survey) -> tuple[dict[str, Camera], dict[str, str]]:
    """Cameras in recordings' form, and the treatment of each one's images, in words."""
    cameras: dict[str, Camera] = {}
    fates: dict[str, str] = {}
    for name, key in dataset.keys.items():
        feature = dataset.info.features[key]
        cameras[name] = dataset.camera(name)
        if feature.is_depth:
            fates[name] = "the distances of its codes, in metres (32FC1)"
        elif feature.is_video and name in survey.formats:
            if len(survey.formats[name]) > 1:
                raise ExportError(f"The videos of {key} are of several codecs or sizes: {dataset.root}")
            ((codec, _),), reason = survey.formats[name], survey.reasons[name]
            if reason:
                cameras[name] = replace(cameras[name], kept="")
            fates[name] = f"{codec}, encoded once, since {reason}" if reason else f"{codec}, passed through as it is"
        else:
            fates[name] = "images of their own, encoded once"
    return cameras, fates


def _write(
    recording: DatasetRecording,
    cameras: Mapping[str, Camera],
    folder: ExternalFolder,
    video: VideoConfig,
    digest: Callable[[Path], str],
) -> bool:
    """Write an episode of the run unless it exists."""
    info, subtasks = _info(recording, cameras, digest), dict(recording.subtasks)
    if folder.has(info):
        return False
    leads = {camera.name: recording.lead(camera.name) if camera.kept else 0 for camera in info.cameras}
    table = recording.table_with(leads)
    images: dict[str, Iterator[Image]] = {}
    for camera in info.cameras:
        if camera.is_depth:
            images[camera.name] = recording.distances(camera.name)
        elif camera.kept:
            images[camera.name] = (packet.data for packet in recording.packets(camera.name))
        else:
            images[camera.name] = islice(recording.images(camera.name), recording.lead(camera.name), None)
    add_episode(folder, info, table, images, outcome=recording.outcome, video=video, subtasks=subtasks)
    return True


def _info(recording: DatasetRecording, cameras: Mapping[str, Camera], digest: Callable[[Path], str]) -> EpisodeInfo:
    """Description of an episode for its recording."""
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
