"""Read recordings into `Evidence`: simulated, made by the recorder, or imported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.errors import DemorecError, resource_error, without_path
from demorec.core.geometry import Array
from demorec.episode.episode import NO_IMAGE, Table
from demorec.episode.info import EpisodeInfo
from demorec.episode.protocol import Episode
from demorec.episode.roles import COUNTERS, Column, NamedRoles, Roles, find_roles, roles_of_recording
from demorec.extensions.doctor.evidence import EpisodeEvidence, Evidence, continuous, joined
from demorec.extensions.doctor.from_dataset import ReadOptions
from demorec.extensions.doctor.thumbnails import CameraThumbnails, Shrinker, frames_of
from demorec.mcap import open_recording

_NANOSECONDS = 1e9


def evidence_of_recordings(path: Path, files: Sequence[Path], options: ReadOptions) -> Evidence:
    """Read recordings as one set; an unreadable one is excluded alone.

    Args:
        path: Path given by the user.
        files: The recordings, in order; they are numbered by their index here.
        options: Options for reading.

    Raises:
        ConfigError: The user named a feature that a recording lacks, or one of a simulated recording.
    """
    episodes: list[EpisodeEvidence] = []
    unreadable: dict[int, str] = {}
    images: dict[str, CameraThumbnails] = {}
    first: EpisodeInfo | None = None
    roles: Roles | None = None
    urdf = options.urdf
    for number, file in enumerate(files):
        options.progress(number + 1, len(files))
        try:
            with open_recording(file) as recording:
                own = roles_of_recording(recording.info, options.named)
                if first is None or roles is None:
                    first, roles = recording.info, own
                    urdf = urdf or recording.info.urdf or recording.description()
                table = recording.table()
                episodes.append(_episode(number, recording, table, roles))
                for camera in recording.cameras if options.images else ():
                    _read_images(number, recording, table, camera, images.setdefault(camera, CameraThumbnails()))
        except DemorecError as error:
            if (lack := resource_error(error)) is not None:
                raise lack from error
            unreadable[number] = without_path(error, file)
    features = () if first is None or roles is None else [f for f in first.features if f.name in roles.state]
    joints = tuple(joint for f in features for joint in f.joints or ("",) * len(f.names))
    return Evidence(
        path=path,
        fps=30.0 if first is None else float(first.fps),
        roles=_with_cameras(roles, images),
        episodes=episodes,
        unreadable=unreadable,
        cameras=images,
        images_missing="" if options.images else "images are not decoded (--no-images)",
        urdf=urdf,
        arm_joints=joints if any(joints) else (),
        names={number: file.name for number, file in enumerate(files)},
    )


def _with_cameras(roles: Roles | None, images: Mapping[str, Any]) -> Roles:
    """Add the roles of the cameras, which recordings store separately."""
    if roles is None:
        return find_roles({}, NamedRoles())
    of = {**roles.of, **dict.fromkeys(images, "camera")}
    return Roles(
        of={name: role for name, role in of.items() if name not in COUNTERS},  # type: ignore[misc]
        columns={**roles.columns, **{name: Column("video") for name in images}},
        state=roles.state,
        action=roles.action,
        named=roles.named,
    )


def _episode(number: int, recording: Episode, table: Table, roles: Roles) -> EpisodeEvidence:
    info = recording.info
    known = {feature.name: feature for feature in info.features}
    columns = dict(table.features)
    in_si = {
        name: known[name].in_si(values) if name in known and values.dtype.kind == "f" else values
        for name, values in columns.items()
    }
    ages: dict[str, Array] = {name: table.age_ns(name) / _NANOSECONDS for name in table.stamps}
    for camera, shown in table.images.items():
        age = np.full(len(shown), np.nan)
        age[shown != NO_IMAGE] = table.image_age_ns(camera) / _NANOSECONDS
        ages[camera] = age
    drops = {} if recording.outcome is None else recording.outcome.drops
    return EpisodeEvidence(
        number=number,
        instruction=info.instruction,
        columns=columns,
        state=continuous(joined(roles.state, in_si), roles.elements(roles.state)),
        action=continuous(joined(roles.action, in_si), roles.elements(roles.action)),
        time_s=table.time_ns / _NANOSECONDS,
        image_ages_s=ages if info.simulation is None else {},
        drops=", ".join(f"{count} of {what}" for what, count in drops.items() if count),
    )


def _read_images(number: int, recording: Episode, table: Table, camera: str, into: CameraThumbnails) -> None:
    """Decode the images of a camera; each belongs to the first frame that shows it."""
    if camera not in table.images:
        return
    try:
        images = Shrinker().shrink(frames_of(recording.images(camera)))
    except DemorecError as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        into.errors[number] = str(error)
        return
    held, frames = np.unique(table.images[camera], return_index=True)
    shown = (held != NO_IMAGE) & (held < len(images.thumbnails))
    into.episodes[number] = images.taken(held[shown], frames[shown])
