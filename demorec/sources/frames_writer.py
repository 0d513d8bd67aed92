"""What imported episodes say of themselves; and the writing of one whose frames are evenly spaced, as in datasets."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.files import read_text_limited
from demorec.episode.episode import Outcome, Sample, SampledFrame, Vector, frame_time_ns
from demorec.episode.features import STATE
from demorec.episode.info import Camera, EpisodeInfo, Feature, Origin, SourceFile
from demorec.mcap import SampledWriter
from demorec.robots.known_models import remember_model
from demorec.robots.urdf import Urdf
from demorec.runs.external import ExternalFolder, episode_path
from demorec.sources.fields import FieldError
from demorec.sources.mapping import SourceMapping

Image = bytes | NDArray[Any]
"""A packet that stays as it is, (H, W, 3) uint8 RGB, or (H, W) distances as `SampledWriter.image` takes them."""


@dataclass(frozen=True, kw_only=True)
class FramesImport:
    """What an import of such episodes made.

    Attributes:
        num_episodes, num_frames: In the run.
        num_new: Episodes that were written now; the others were there.
        cameras: Camera -> what became of its images, in words.
        left_out: What the run does not have, by its name in the source -> why; "" for what the mapping does not name.
        skipped: Episode that cannot be read -> why.
    """

    num_episodes: int
    num_frames: int
    num_new: int
    cameras: Mapping[str, str]
    left_out: Mapping[str, str]
    skipped: Mapping[str, str] = field(default_factory=dict)

    def left_out_lines(self) -> Iterator[str]:
        """What the run does not have, for people."""
        yield from (f"{name} is left out: {reason}." for name, reason in self.left_out.items() if reason)
        if unnamed := [name for name, reason in self.left_out.items() if not reason]:
            yield f"The mapping does not name, and so the run does not have: {', '.join(unnamed)}."


@cache
def importing_versions() -> Mapping[str, str]:
    """Of what reads and writes an episode, for its recording."""
    return {name: version(name) for name in ("demorec", "av")}


def imported_feature(
    name: str, dtype: DTypeLike, names: tuple[str, ...], units: Iterable[str], *, called: Iterable[str], source: str
) -> Feature:
    """A feature as recordings know it; `called` is how the joints are called that its elements may be of."""
    units = tuple("deg" if unit == "degree" else unit for unit in units)
    return Feature(
        name=name,
        dtype="float32" if dtype == np.float32 else "float64",
        names=names,
        units=units if any(units) else (),
        joints=tuple(called) if name == STATE else (),
        source=source,
    )


def imported_info(
    mapping: SourceMapping,
    *,
    episode_index: int,
    instruction: str,
    urdf: str | None,
    fps: int,
    features: Iterable[Feature],
    cameras: Iterable[Camera],
    files: Iterable[SourceFile],
) -> EpisodeInfo:
    """What is known of an episode that was imported by a mapping.

    Args:
        urdf: The robot's model; None where there is none.

    Raises:
        FieldError: The model is none.
    """
    try:
        joints = set() if urdf is None else {joint.name for joint in Urdf.parse(urdf).joints}
    except ValueError as error:
        raise FieldError(f"the robot's model cannot be used ({error})") from error

    def moved(feature: Feature) -> Feature:
        names = tuple(name if name in joints else "" for name in feature.joints)
        return replace(feature, joints=names if any(names) else ())

    return EpisodeInfo(
        episode_index=episode_index,
        instruction=" ".join(instruction.split()),
        robot_name=mapping.robot.name,
        urdf=urdf or "",
        fps=fps,
        features=tuple(map(moved, features)),
        cameras=tuple(cameras),
        origin=Origin(kind="import", files=tuple(files), mapping_digest=mapping.digest),
        versions=importing_versions(),
    )


_MAX_URDF_BYTES = 4 << 20


def urdf_text(mapping: SourceMapping, mapping_path: Path) -> str | None:
    """The URDF that a mapping names a file for; None when it names none. ConfigError when it cannot be read."""
    if not mapping.robot.urdf:
        return None
    path = mapping_path.parent / mapping.robot.urdf
    try:
        text = read_text_limited(path, _MAX_URDF_BYTES)
        remember_model(text, path)
        return text or None
    except (OSError, ValueError) as error:  # no text, or NUL in the name
        raise ConfigError(f"The URDF cannot be read ({getattr(error, 'strerror', 'it is no text')}): {path}") from error


def write_frames(
    folder: ExternalFolder,
    info: EpisodeInfo,
    frames: Iterable[Mapping[str, Vector]],
    images: Mapping[str, Iterator[Image]],
    *,
    outcome: Outcome,
    video: VideoConfig,
    leads: Mapping[str, int] | None = None,
    subtasks: Mapping[int, str] | None = None,
    times_ns: NDArray[np.int64] | None = None,
) -> None:
    """Record an episode of a run: whole, or not at all.

    Args:
        folder: The run.
        info: What is known of the episode.
        frames: Feature -> its vector, of each frame.
        images: Camera -> its images, one a frame, its lead in front.
        outcome: How it ended, of as many frames.
        video: How pixels are encoded.
        leads: Camera -> how many of its images come before the first frame; 0 where not given.
        subtasks: Frame -> what the robot begins to do with it.
        times_ns: (T,) stamps of the frames, behind the images that come before them; None for `info.fps`.

    Raises:
        ConfigError: The run holds episodes of another kind.
        RecordingError: A number is not finite, or the disk is full.
    """
    folder.check_fits(info)
    folder.begin(info)
    path = episode_path(folder.path, info.episode_index)
    leads = leads or {}
    begin = max(leads.values(), default=0)
    with SampledWriter(path, info, video=video, keeps_part=False) as writer:
        for name, lead in leads.items():
            for number in range(begin - lead, begin):
                writer.image(name, frame_time_ns(number, info.fps), next(images[name]))
        count = 0
        for vectors in frames:
            if times_ns is None:
                time_ns = frame_time_ns(begin + count, info.fps)
            else:
                time_ns = frame_time_ns(begin, info.fps) + int(times_ns[count])
            shown = {name: writer.image(name, time_ns, next(stream)) for name, stream in images.items()}
            samples = {name: Sample(stamp_ns=time_ns, vector=vector) for name, vector in vectors.items()}
            subtask = (subtasks or {}).get(count, "")
            writer.write(SampledFrame(time_ns=time_ns, samples=samples, images=shown, subtask=subtask))
            count += 1
        writer.finish(replace(outcome, num_frames=count))
    folder.add(path)
