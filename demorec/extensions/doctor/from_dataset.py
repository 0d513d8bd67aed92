"""Read a LeRobot dataset into `Evidence`: each table and each image once."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import count, groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError
from demorec.datasets.lerobot.robots import DatasetRobot
from demorec.episode.features import STATE
from demorec.episode.info import Feature
from demorec.episode.roles import NO_NAMES, NamedRoles
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import noted, usable_numbers
from demorec.extensions.datasets.robots import described, recognised_robot, robot_of_motors
from demorec.extensions.datasets.videos import opened_video
from demorec.extensions.doctor.diagnosis import diagnose
from demorec.extensions.doctor.evidence import EpisodeEvidence, Evidence, continuous, joined
from demorec.extensions.doctor.thumbnails import CameraThumbnails, Shrinker, frames_of
from demorec.robots.motors import Motors
from demorec.runs.find import find


def no_progress(done: int, total: int) -> None:
    """Report nothing."""


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Options for reading evidence.

    Attributes:
        images: Whether images are decoded.
        named: Features with a role named by the user.
        motors: Servos that state and action belong to, if given by the user.
        urdf: Text of the robot's description given by the user, "" for none.
        lerobot: Whether to open the dataset with the installed LeRobot.
        progress: Called with the number of parts read, and of all parts.
    """

    images: bool = True
    named: NamedRoles = NO_NAMES
    motors: Motors | None = None
    urdf: str = ""
    lerobot: bool = False
    progress: Callable[[int, int], None] = no_progress


def evidence_of_dataset(root: Path, options: ReadOptions) -> Evidence:
    """Read a dataset; unreadable data excludes only its episode.

    Raises:
        ConfigError: The dataset lacks a feature that the user named.
        ExportError: info.json or the table of episodes cannot be read.
    """
    folder = LeRobotFolder(root, named=options.named)
    roles = folder.roles
    readable: list[EpisodeEvidence] = []
    unreadable: dict[int, str] = {}
    elements = roles.elements(roles.state)
    robot_problems: list[str] = []
    robot: DatasetRobot | None = None
    with noted(robot_problems, root):
        robot = _robot(folder, options, elements)
    units = None if options.urdf else robot
    reader = folder.rows([name for name in folder.columns if folder.info.features[name].dtype != "image"])
    cameras = _camera_names(folder) if options.images else []
    total, done = len(folder.listed) * (1 + len(cameras)), count(1)

    def advance() -> None:
        """Count an episode's rows, or its images of one camera, as read."""
        options.progress(next(done), total)

    for place in folder.listed:
        advance()
        problems: list[str] = []
        columns: Mapping[str, NDArray[Any]] = {}
        with noted(problems, root):
            columns = usable_numbers(folder, reader, place)
        if problems:
            unreadable[place.episode_index] = problems[0]
            continue
        in_units = columns if units is None else _in_si(columns, units, roles.state, roles.action)
        readable.append(
            EpisodeEvidence(
                number=place.episode_index,
                instruction="; ".join(place.tasks),
                columns=columns,
                state=continuous(joined(roles.state, in_units), elements),
                action=continuous(joined(roles.action, in_units), roles.elements(roles.action)),
                time_s=columns["timestamp"][:, 0].astype(np.float64) if "timestamp" in columns else None,
            )
        )
    return Evidence(
        path=root,
        fps=float(folder.info.fps),
        roles=roles,
        episodes=readable,
        unreadable=unreadable,
        folder=folder,
        cameras=_cameras(folder, cameras, unreadable, advance),
        images_missing=_why_no_images(folder) if options.images else "images are not decoded (--no-images)",
        urdf=options.urdf or ("" if robot is None else robot.urdf),
        robot_problem="; ".join(robot_problems),
        arm_joints=_joints(robot, folder, elements),
        opens_lerobot=options.lerobot,
    )


def _robot(folder: LeRobotFolder, options: ReadOptions, elements: tuple[str, ...]) -> DatasetRobot | None:
    """Determine the robot from the user's servos, the sidecar, or the elements' names."""
    if options.motors is not None and elements == options.motors.names:
        return robot_of_motors(options.motors)
    digests = {row["robot_digest"] for row in folder.sidecar(["robot_digest"])} - {None}
    if len(digests) == 1:
        return folder.robot(digests.pop())
    return recognised_robot(elements) if elements else None


def _joints(robot: DatasetRobot | None, folder: LeRobotFolder, elements: tuple[str, ...]) -> tuple[str, ...]:
    if robot is None:
        return ()
    state = folder.roles.state
    known = robot.joints.get(state[0], robot.joints.get(STATE, ())) if len(state) == 1 else ()
    return known if len(known) == len(elements) else ()


def _in_si(
    columns: Mapping[str, NDArray[Any]], robot: DatasetRobot, state: Sequence[str], action: Sequence[str]
) -> Mapping[str, NDArray[Any]]:
    """Convert state and action columns to rad and m, by the units in the robot's record."""
    found = dict(columns)
    for name in (*state, *action):
        width = columns[name].shape[1]
        usual_name = "action" if name in action else STATE
        feature = described(robot, Feature(name=name, names=tuple(map(str, range(width)))), usual_name)
        found[name] = feature.in_si(columns[name])
    return found


def _why_no_images(folder: LeRobotFolder) -> str:
    """Explain why no image is examined because all video files are missing; "" if some exist, or no cameras."""
    keys = folder.info.video_keys
    if keys and all(folder.is_absent(key) for key in keys):
        return f"no video of {', '.join(keys)} is here; download them"
    return ""


def _camera_names(folder: LeRobotFolder) -> list[str]:
    """List the colour cameras of which at least one file is here."""
    return [
        key
        for key, feature in folder.info.features.items()
        if feature.is_camera and not feature.is_depth and not (feature.is_video and folder.is_absent(key))
    ]


def _cameras(
    folder: LeRobotFolder, keys: Sequence[str], unreadable: Collection[int], advance: Callable[[], None]
) -> dict[str, CameraThumbnails]:
    found = {}
    for key in keys:
        images = CameraThumbnails()
        if folder.info.features[key].is_video:
            _read_videos(folder, key, images, advance)
        else:
            _read_stored(folder, key, unreadable, images, advance)
        if images.episodes or images.errors:
            found[key] = images
    return found


def _read_videos(folder: LeRobotFolder, key: str, images: CameraThumbnails, advance: Callable[[], None]) -> None:
    """Decode a camera's videos, each file in one pass."""
    shrinker = Shrinker()
    for path, group in groupby(folder.listed, key=lambda place: place.videos[key][0]):
        places = list(group)
        problems: list[str] = []
        with noted(problems, folder.root), opened_video(path) as opened:
            for place in places:
                advance()
                own: list[str] = []
                with noted(own, folder.root):
                    decoded = folder.video(key, place).decoded(opened=opened)
                    images.episodes[place.episode_index] = shrinker.shrink(decoded)
                if own:
                    images.errors[place.episode_index] = own[0]
        if problems:
            missing = [place.episode_index for place in places if place.episode_index not in images.episodes]
            images.errors.update(dict.fromkeys(missing, problems[0]))


def _read_stored(
    folder: LeRobotFolder, key: str, unreadable: Collection[int], images: CameraThumbnails, advance: Callable[[], None]
) -> None:
    shrinker = Shrinker()
    for place in (place for place in folder.listed if place.episode_index not in unreadable):
        advance()
        problems: list[str] = []
        with noted(problems, folder.root):
            images.episodes[place.episode_index] = shrinker.shrink(frames_of(folder.stored_images[key].read(place)))
        if problems:
            images.errors[place.episode_index] = problems[0]


def judged_columns(folder: LeRobotFolder, names: Collection[str]) -> list[dict[str, Any]]:
    """Judge each episode: the "verdict", the "score", or both.

    The verdict needs the images, which takes as long as `demorec check`; the score needs only the tables.
    """
    evidence = evidence_of_dataset(folder.root, ReadOptions(images="verdict" in names))
    found = {each.episode: each for each in diagnose(evidence).episodes}
    numbers = [place.episode_index for place in folder.places]
    return [{name: getattr(found.get(number), name, None) for name in names} for number in numbers]


def by_score(paths: Sequence[Path], named: NamedRoles) -> dict[str, str]:
    """Rank the episodes of datasets by verdict and score, the worst first: name of its `PlaybackSource` -> its reason.

    Raises:
        ConfigError: A path is not a dataset.
    """
    if others := [path for path in paths if find(path).kind != "dataset"]:
        raise ConfigError(f"--rank score is for LeRobot datasets, and this is not one: {others[0]}")
    options = ReadOptions(images=False, named=named)
    found = [(path, each) for path in paths for each in diagnose(evidence_of_dataset(path, options)).episodes]
    ranked = {}
    for path, each in sorted(found, key=lambda pair: pair[1].rank):
        reasons = "; ".join(each.reasons)
        line = f"{each.verdict}, {each.score:.2f}  episode {each.episode}{': ' * bool(reasons)}{reasons}"
        ranked[f"{path}: episode {each.episode}"] = line
    return ranked
