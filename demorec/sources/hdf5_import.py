"""HDF5 files of robomimic's or ALOHA's layout become runs: numbers to the bit, JPEG files as they are.

All files are looked through before anything is written; then rows and pictures pass in pieces. The same command again
goes on: episodes that are there are not written.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.datasets.hdf5.foreign import ForeignFile, Hdf5Error, StoredArray
from demorec.episode.episode import Outcome
from demorec.episode.external import EpisodeInfo, Origin, SourceFile, Vector
from demorec.mcap.external.validity import what_is_wrong
from demorec.robots.urdf import Urdf
from demorec.runs.external import differences, open_external_run
from demorec.runs.find import expect
from demorec.runs.run_file import sha256_of
from demorec.sources.description import urdf_text
from demorec.sources.frames_writer import FramesImport, write_frames
from demorec.sources.hdf5_episodes import episode_places, found_attribute, rate_of, success_of, task_of
from demorec.sources.hdf5_features import Hdf5FitError, StoredFeature
from demorec.sources.hdf5_mapping import Hdf5Mapping
from demorec.sources.hdf5_pictures import StoredCamera, is_camera, picture_lengths
from demorec.sources.mapping_file import read_mapping_file
from demorec.sources.words import quoted

_LENGTHS = "compress_len"
"""Where ALOHA's recorders say how long the JPEG file in each row is, without what pads it."""


def import_hdf5(
    paths: Sequence[Path], mapping_path: Path, out: Path, *, video: VideoConfig | None = None
) -> FramesImport:
    """Import HDF5 files into a run, by a mapping; datasets of the first episode that it does not name are left out.

    Args:
        paths: Of the files, in the order of their episodes.
        mapping_path: Of the mapping.
        out: The run's folder; one that the same files and mapping began is continued.
        video: How pictures are coded that come as pixels.

    Raises:
        ConfigError: The mapping is impossible, the files differ, or the folder holds something else.
        Hdf5Error: A file cannot be read, or does not fit the mapping.
        RecordingError: The disk is full or gone.
    """
    mapping = read_mapping_file(mapping_path, Hdf5Mapping)
    urdf = urdf_text(mapping.robot.urdf, mapping_path)
    for path in paths:
        expect(path, "hdf5")
    if len({path.resolve() for path in paths}) < len(paths):
        raise ConfigError("A file is given twice: name each once.")
    plans: list[_Plan] = []
    left_out: dict[str, str] = {}
    for path in paths:
        with ForeignFile(path) as file:
            source = SourceFile(name=path.name, sha256=sha256_of(path))
            places = episode_places(file, mapping.episodes)
            for place in places:
                plans.append(_Plan(file, place, mapping, urdf, source, len(plans)))
                _make_alike(plans[-1], plans[0])
            left_out = {**_unnamed(file, places[0], mapping), **left_out}
    if any(plan.has_last for plan in plans):
        left_out["the last observation of each episode"] = "no action follows it"
    return FramesImport(
        num_episodes=len(plans),
        num_frames=sum(plan.num_frames for plan in plans),
        num_new=_write(plans, mapping, out, video or VideoConfig()),
        cameras=plans[0].told,
        left_out=left_out,
    )


class _Stored:
    """An episode in an opened file; Hdf5FitError when its datasets do not fit the mapping."""

    def __init__(self, file: ForeignFile, place: str, mapping: Hdf5Mapping) -> None:
        def array(name: str, *, may_be_ragged: bool = False) -> StoredArray:
            return file.array("/".join(filter(None, (place, name.strip("/")))), may_be_ragged=may_be_ragged)

        self.features: list[StoredFeature] = []
        for name, parts in mapping.features.items():
            following = parts[0].next
            used = mapping.features[following] if following else parts
            arrays = [array(part.dataset) for part in used]
            self.features.append(StoredFeature(name, used, arrays, shift=1 if following else 0))
        cameras = {
            name: (camera, array(camera.dataset, may_be_ragged=True)) for name, camera in mapping.cameras.items()
        }
        observed = [pictures for _, pictures in cameras.values()]
        others: list[StoredArray] = []
        for feature in self.features:
            arrays = others if not feature.name.startswith("observation.") else observed
            arrays += [] if feature.shift else [column.array for column in feature.columns]
        self.num_rows = num_rows = _num_rows(observed, others)
        self.has_last = len(observed[0]) > num_rows
        told = file.attribute(place, "num_samples")
        if told is not None and told != num_rows:
            raise Hdf5FitError(
                f"{place or 'the episode'} has {num_rows} rows, but its attribute num_samples says {reprlib.repr(told)}"
            )
        files = [pictures for _, pictures in cameras.values() if len(pictures.shape) == 2]
        is_told = files and file.has(f"{place}/{_LENGTHS}")
        lengths = picture_lengths(array(_LENGTHS), len(files[0])) if is_told else None
        self.num_frames = min(num_rows, len(observed[0]) - max(feature.shift for feature in self.features))
        if self.num_frames < 1:
            raise Hdf5FitError(f"{place or 'the episode'} has {num_rows} rows, too few for a frame")
        self.cameras = [
            StoredCamera(name, camera, pictures, lengths if len(pictures.shape) == 2 else None)
            for name, (camera, pictures) in cameras.items()
        ]

    def frames(self) -> Iterator[dict[str, Vector]]:
        """Feature -> (D,) of each frame."""
        columns = [feature.vectors(self.num_frames) for feature in self.features]
        for vectors in zip(*columns, strict=True):
            yield {feature.name: vector for feature, vector in zip(self.features, vectors, strict=True)}


def _num_rows(observed: Sequence[StoredArray], others: Sequence[StoredArray]) -> int:
    """Of an episode: observations may have one more than actions, what the last action led to.

    Raises:
        Hdf5FitError: They have other numbers of rows.
    """
    num_rows = len((others or observed)[0])
    has_last = len(observed[0]) == num_rows + 1
    for arrays, wanted in ((others, num_rows), (observed, num_rows + has_last)):
        for array in arrays:
            if len(array) != wanted:
                raise Hdf5FitError(f"{array.place} has {len(array)} rows, other datasets of the episode have {wanted}")
    return num_rows


def _write(plans: Sequence[_Plan], mapping: Hdf5Mapping, out: Path, video: VideoConfig) -> int:
    """Record what is not there; how many episodes that were."""
    with open_external_run(out, recovers=False) as folder:
        missing = [plan for plan in plans if not folder.has(plan.info)]
        for plan in missing:
            with ForeignFile(plan.path) as file, _named(plan.path):
                episode = _Stored(file, plan.place, mapping)
                pictures = {camera.name: camera.pictures() for camera in episode.cameras}
                outcome = Outcome(success=plan.success, num_frames=plan.num_frames)
                write_frames(folder, plan.info, episode.frames(), pictures, outcome=outcome, video=video)
    return len(missing)


class _Plan:
    """What an episode shall be; every number is looked at."""

    def __init__(
        self, file: ForeignFile, place: str, mapping: Hdf5Mapping, urdf: str, source: SourceFile, episode_index: int
    ) -> None:
        self.path, self.place = file.path, place
        with _named(file.path):
            episode = _Stored(file, place, mapping)
            for _ in episode.frames():
                pass
            if attribute := mapping.robot.urdf_attribute:
                urdf = str(found_attribute(file, place, attribute) or "")
            try:
                joints = {joint.name for joint in Urdf.parse(urdf).joints} if urdf or attribute else set()
            except ValueError as error:
                raise Hdf5FitError(f"the robot's model cannot be used ({error})") from error
            self.info = EpisodeInfo(
                episode_index=episode_index,
                instruction=task_of(file, place, mapping),
                robot=mapping.robot.name,
                urdf=urdf,
                fps=rate_of(file, place, mapping),
                features=tuple(feature.described(joints) for feature in episode.features),
                cameras=tuple(camera.described() for camera in episode.cameras),
                origin=Origin(kind="import", files=(source,), mapping_digest=mapping.digest),
                versions={"demorec": version("demorec"), "av": version("av")},
            )
            if wrong := what_is_wrong(self.info):
                raise Hdf5FitError("; ".join(wrong))
            self.num_frames, self.has_last = episode.num_frames, episode.has_last
            self.success = success_of(file, place, mapping, episode.num_rows)
            self.told = {camera.name: f"{camera.width}x{camera.height}, {camera.told}" for camera in episode.cameras}


def _make_alike(plan: _Plan, first: _Plan) -> None:
    """Let an episode share the first one's model, a long text, in memory; ConfigError when it differs."""
    if different := differences(first.info, plan.info):
        name = f"{plan.place} of {plan.path}" if plan.place else str(plan.path)
        raise ConfigError(f"The episodes differ ({'; '.join(different)}): import {name} into another run.")
    plan.info = replace(plan.info, urdf=first.info.urdf)


def _unnamed(file: ForeignFile, place: str, mapping: Hdf5Mapping) -> dict[str, str]:
    """Datasets that the mapping does not name; groups of which it names none, as one.

    Raises:
        Hdf5Error: There are cameras among them, of which it does not say that they shall be left out.
    """
    used = {name.partition("/")[0] for name in mapping.datasets}
    found: dict[str, str] = {}
    cameras: dict[str, None] = {}
    for dataset in file.datasets(place):
        name = dataset.removeprefix(place).lstrip("/")
        if name not in mapping.datasets and name != _LENGTHS:
            group = name.partition("/")[0]
            shown = name if group in used else group
            found[shown] = ""
            if not mapping.leaves_out(name):
                with suppress(Hdf5Error):  # what cannot be read is none
                    cameras |= {shown: None} if is_camera(file.array(dataset, may_be_ragged=True)) else {}
    if cameras:
        raise Hdf5Error(
            f"The mapping does not name the cameras in {', '.join(cameras)} of {place or 'the file'}: give them a "
            f"[cameras.NAME] each, or write above its tables leave_out = [{', '.join(map(quoted, cameras))}]: "
            f"{file.path}"
        )
    return found


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """What does not fit is told with the file's name."""
    try:
        yield
    except Hdf5FitError as error:
        raise Hdf5Error(f"The mapping does not fit the file: {error}: {path}") from error
