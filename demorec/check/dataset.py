"""A LeRobot dataset, opened for its checks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Form, NotMeasured
from demorec.check.cells import Cells
from demorec.check.coverage import motion_vector
from demorec.check.drawn import NOT_DRAWABLE, ImageComparison, compare, draw, frames_to_draw
from demorec.check.episode import CheckedEpisode
from demorec.check.episode_drawn import drawable_scene
from demorec.check.evidence import Motions, Named, course_of, motions_of_dataset, quaternions
from demorec.check.films import Film, Films, films_of_dataset, likeness_of_films
from demorec.check.rows import LinkMatrices
from demorec.core.errors import ConfigError, ExportError, describe_error
from demorec.core.geometry import Array
from demorec.datasets.lerobot.files import open_table, read_table, tables_in
from demorec.datasets.lerobot.language import COLUMNS, EpisodeLanguage, spoken_of
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetInfo
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.reader import EpisodePlace, RowStream, episode_places, read_tasks
from demorec.datasets.lerobot.robots import DatasetRobot, read_robot, robot_of_motors
from demorec.datasets.lerobot.sidecar import EPISODE_SCHEMA
from demorec.episode.features import (
    ACTION,
    EE_POSE,
    IMAGE_PREFIX,
    STATE,
    STATE_KINDS,
    ActionKind,
    StateKind,
    action_names,
    state_names,
)
from demorec.episode.info import EpisodeInfo
from demorec.episode.scene import Body
from demorec.episode.validity import read_episode_info
from demorec.render.recorded import RecordedWorld
from demorec.robots.assets import asset_path
from demorec.robots.motors import Motors
from demorec.robots.urdf import Urdf

Rows = Mapping[str, NDArray[Any]]


_IN_THE_AIR = 0.01
"""Metres above all that is below it."""
_DRAWN_SECONDS = 3.0
"""Of an episode that are drawn, at most."""
_CLOSING = 1e-3
"""Metres that the opening shrinks by from frame to frame when the fingers begin to close."""
_MIN_DRAWN = 3
_NEEDED = (
    "episode_index", "success", "num_retries", "content_digest", "phases", "objects", "episode_info",
)  # fmt: skip
"""Columns of the sidecar that all versions have."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DescribedEpisode:
    """A simulated episode of a dataset, and what the sidecar keeps of it.

    Attributes:
        number: Its `episode_index`.
        rows: Feature -> (T, D).
        tasks: Instructions.
        kept: Its row of the sidecar.
        info: What was known before its first frame.
    """

    number: int
    rows: Rows
    tasks: tuple[str, ...]
    kept: dict[str, Any]
    info: EpisodeInfo


class Dataset:
    """A LeRobot v3.0 dataset, read without LeRobot; properties raise ExportError where the files do not give them.

    Args:
        path: Its folder.
        urdf: Text of its robot's description that the user names, "" for none.
        motors: The servos whose values its state and actions are, if the user says so.
    """

    form: ClassVar[Form] = "dataset"
    has_equal_starts: ClassVar[bool] = False
    """Nobody says so."""

    def __init__(self, path: Path, urdf: str = "", motors: Motors | None = None) -> None:
        self.path, self.urdf, self.motors = path, urdf, motors
        self._films: dict[str, list[Film]] = {}

    @cached_property
    def info(self) -> DatasetInfo:
        """meta/info.json."""
        return DatasetInfo.load(self.path)

    @cached_property
    def places(self) -> list[EpisodePlace]:
        """The episodes' table."""
        return list(episode_places(self.path, self.info))

    @cached_property
    def tasks(self) -> list[str]:
        """Instructions."""
        return read_tasks(self.path)

    @cached_property
    def rows(self) -> list[Rows]:
        """Feature -> (T, D) of every episode: all counters are there, no episode is empty, every number is one."""
        missing = [name for name in AUTOMATIC_FEATURES if name not in self.info.features]
        if missing:
            raise ExportError(f"info.json has no feature {', '.join(missing)}: {self.path}")
        reader = RowStream(self.info)
        return [self._usable(place, reader.numbers(place)) for place in self.places]

    def _usable(self, place: EpisodePlace, rows: Rows) -> Rows:
        if place.length == 0:
            raise ExportError(f"Episode {place.episode_index} has no frames: {self.path}")
        for name, values in rows.items():
            kind = self.info.features[name].dtype
            if kind in ("int64", "bool") and values.dtype.kind not in "iub":
                raise ExportError(f"Episode {place.episode_index} lacks values of {name}: {self.path}")
            if values.dtype.kind == "f" and not (finite := np.isfinite(values)).all():
                frame, component = (int(number) for number in np.argwhere(~finite)[0])
                raise ExportError(
                    f"Episode {place.episode_index} has no number in {name}[{component}] at frame {frame}: {self.path}"
                )
        return rows

    @cached_property
    def motions(self) -> Motions:
        """Those of its episodes."""
        return Motions(list(motions_of_dataset(self.info, self.rows, self._arms, self.urdf)))

    @property
    def _arms(self) -> dict[int, DatasetRobot]:
        """Episode -> its arm, where the sidecar has it or the user has named its servos."""
        names = self.info.features[STATE].names if STATE in self.info.features else None
        if self.motors is not None and names == self.motors.names:
            return dict.fromkeys(range(len(self.places)), robot_of_motors(self.motors))
        return {row["episode_index"]: self.robots[row["robot_digest"]] for row in self._named}

    def quaternions(self) -> Iterator[Named]:
        """All rotations, by the names of their elements."""
        known = {name: feature.names for name, feature in self.info.features.items() if feature.is_numeric}
        for number, rows in enumerate(self.rows):
            yield from ((f"{name}, episode {number}", table) for name, table in quaternions(rows, known))

    def likeness_of_cameras(self) -> Iterator[tuple[str, float]]:
        """(two cameras, correlation of their images in an episode)."""
        return likeness_of_films(self.films)

    @property
    def colour_keys(self) -> list[str]:
        """Names of the camera features, less those of depth."""
        return [key for key in self.info.video_keys if not self.info.features[key].is_depth]

    def films_of(self, key: str) -> list[Film]:
        """Those of a camera in each episode, beside the states; decoded by the first call."""
        if key not in self._films:
            known = self.info.features.get(STATE)
            states = [course_of(rows[STATE], known.names or ()) if known else None for rows in self.rows]
            self._films[key] = films_of_dataset(self.info, self.places, key, states)
        return self._films[key]

    @property
    def films(self) -> Films:
        """Those of all its cameras that show colours."""
        return {key: self.films_of(key) for key in self.colour_keys}

    def distances(self) -> Iterator[tuple[str, Iterator[NDArray[Any]]]]:
        """Of none: of depth videos the length counts."""
        return iter(())

    @cached_property
    def compared(self) -> list[tuple[int, str, ImageComparison | NotMeasured]]:
        """(episode, camera, how its images begin against states and scene); only with a sidecar.

        An episode that cannot be compared is there once, without a camera.
        """
        keys = {key.removeprefix(IMAGE_PREFIX): key for key in self.colour_keys}
        found: list[tuple[int, str, ImageComparison | NotMeasured]] = []
        for each in self.described():
            names = [camera.name for camera in each.info.scene.cameras if camera.name in keys]
            seen = {name: self.films_of(keys[name])[each.number].cells.astype(np.float32) for name in names}
            compared = compare_beginning(each.info, each.rows[STATE].astype(np.float64), self.info.fps, seen)
            of_cameras = {"": compared} if isinstance(compared, NotMeasured) else compared
            found += [(each.number, camera, images) for camera, images in of_cameras.items()]
        return found

    @cached_property
    def sidecar(self) -> list[dict[str, Any]]:
        """The rows that demorec keeps beside each episode, those of older versions with fewer columns; empty for a
        dataset of somebody else's."""
        found = []
        for path in tables_in(self.path, f"{SIDECAR_DIR}/episodes"):
            there = set(open_table(path).schema_arrow.names)
            needed = (*_NEEDED, *({"robot_digest"} & there))
            others = [name for name in EPISODE_SCHEMA.names if name in there and name not in needed]
            rows = read_table(path, needed, schema=EPISODE_SCHEMA).to_pylist()
            found += [row | more for row, more in zip(rows, read_table(path, others).to_pylist(), strict=True)]
        return found

    @cached_property
    def robots(self) -> dict[str, DatasetRobot]:
        """Name -> arm, of all that the episodes call by name."""
        return {name: read_robot(self.path, name) for name in sorted({row["robot_digest"] for row in self._named})}

    @property
    def _named(self) -> list[dict[str, Any]]:
        """Rows of the sidecar that say which arm moved, as those of older datasets do not."""
        return [row for row in self.sidecar if row.get("robot_digest")]

    def links(self, each: DescribedEpisode) -> LinkMatrices:
        """Forward kinematics of an episode's states."""
        info, state = each.info, each.rows[STATE].astype(np.float64)
        if name := each.kept.get("robot_digest"):
            urdf = self.robots[name].model
        else:
            urdf = Urdf.load(asset_path(info.robot.urdf), scale=info.scene.robot.scale)
        return LinkMatrices(urdf, dict(zip(info.robot.arm_joints, state.T, strict=False)), len(state))

    @cached_property
    def spoken(self) -> list[EpisodeLanguage]:
        """What the language columns of each episode hold; empty for a dataset without them."""
        if not set(COLUMNS) <= set(self.info.features):
            return []
        stream = RowStream(self.info, COLUMNS)
        return [spoken_of(stream.batches(place), self.path) for place in self.places]

    @cached_property
    def infos(self) -> list[EpisodeInfo]:
        """What was known of each simulated episode before its first frame; empty for a dataset of somebody else's."""
        try:
            return [read_episode_info(row["episode_info"]) for row in self.sidecar if row["episode_info"] is not None]
        except (ValueError, KeyError, TypeError) as error:
            raise ExportError(
                f"The sidecar's episode_info cannot be used ({describe_error(error)}): {self.path}"
            ) from error

    @property
    def successes(self) -> list[EpisodeInfo]:
        """What was known of each simulated episode."""
        return self.infos

    def courses(self) -> tuple[list[str], list[Array], list[Array]]:
        """Names of the episodes and their motions; their starts are in these."""
        motions = [motion_vector(rows[STATE]) for rows in self.rows] if STATE in self.info.features else []
        return [f"episode {number}" for number in range(len(motions))], motions, []

    def numbers(self) -> Iterator[Array]:
        """(T, D) observations and actions of each episode."""
        names = [
            name
            for name, feature in self.info.features.items()
            if feature.is_numeric and (name == ACTION or name.startswith("observation."))
        ]
        for rows in self.rows:
            yield np.concatenate([rows[name].reshape(len(rows["index"]), -1) for name in names], axis=1)

    def tcp_poses(self, info: EpisodeInfo, rows: Rows) -> dict[str, Array]:
        """Feature -> the TCP's poses (T, 7) that it holds, base frame."""
        poses = {EE_POSE: rows[EE_POSE].astype(np.float64)} if EE_POSE in rows else {}
        if self.state_kind(info) == "joint_ee":
            poses[STATE] = rows[STATE].astype(np.float64)[:, -7:]
        return poses

    def hand_poses(self) -> Iterator[tuple[str, Array, Array]]:
        """(where, poses (T, 7), base_from_tcp (T, 4, 4) by the joints) of every simulated episode."""
        for each in self.described():
            rows, info = each.rows, each.info
            if not (poses := self.tcp_poses(info, rows)):
                return
            hand = self.links(each)[info.robot.tcp_link]
            yield from ((f"{name}, episode {each.number}", tcp, hand) for name, tcp in poses.items())

    def check_simulated(self) -> None:
        """Raise ConfigError for a dataset of external episodes, which no simulator can make or replay."""
        if any(row["episode_info"] is None for row in self.sidecar):
            raise ConfigError(
                f"The episodes of this dataset were recorded by another robot or program and have no scene: {self.path}"
            )

    def described(self) -> list[DescribedEpisode]:
        """The simulated episodes that the sidecar describes, if not all: LeRobot's `resume` adds some without."""
        simulated = [row for row in self.sidecar if row["episode_info"] is not None]
        return [
            DescribedEpisode(
                number=number, rows=self.rows[number], tasks=self.places[number].tasks, kept=row, info=info
            )
            for row, info in zip(simulated, self.infos, strict=True)
            if (number := row["episode_index"]) in range(len(self.rows))
        ]

    def action_kind(self, info: EpisodeInfo) -> ActionKind | None:
        """What the action column holds, by the names of its components; None when it is none of ours."""
        names = self.info.features[ACTION].names if ACTION in self.info.features else None
        kinds: tuple[ActionKind, ...] = ("joint", "joint_increment", "ee", "ee_delta")
        return next((kind for kind in kinds if action_names(info.robot, kind) == names), None)

    def state_kind(self, info: EpisodeInfo) -> StateKind | None:
        """What observation.state holds, by the names of its components; None when it is none of ours."""
        names = self.info.features[STATE].names if STATE in self.info.features else None
        return next((kind for kind in STATE_KINDS if state_names(info.robot, kind) == names), None)


def compare_beginning(
    info: EpisodeInfo, state: Array, fps: int, seen: Mapping[str, Cells]
) -> Mapping[str, ImageComparison] | NotMeasured:
    """Camera -> its images until the fingers first close against what states and scene make of them.

    Until then nothing but the robot moves, and the sidecar says where the objects stood, so everything is known.

    Args:
        info: Of the episode, from the sidecar.
        state: (T, n_arm + 1) joint positions (rad) and opening (m) of each row.
        fps: Rows a second.
        seen: Camera -> its images in cells.
    """
    if (renderer := info.config.get("renderer", "raster")) != "raster":
        return NotMeasured(why=f"colours of the renderer {renderer!r} are others than those that are drawn here")
    if not seen:
        return {}
    sizes = {camera.name: (camera.width, camera.height) for camera in info.scene.cameras}
    if uneven := [
        name for name, cells in seen.items() if sizes[name][0] * cells.shape[1] != sizes[name][1] * cells.shape[2]
    ]:
        return NotMeasured(why=f"no square parts cover the images of the camera {uneven[0]}")
    if falling := [body.name for body in info.scene.movable if _is_in_the_air(body, info.scene.bodies)]:
        return NotMeasured(why=f"{falling[0]} starts in the air, and where it falls is not in the dataset")
    num_arm = len(info.robot.arm_joints)
    opening = state[:, num_arm]
    closing = np.flatnonzero(np.diff(opening) < -_CLOSING)
    count = min([len(state), round(_DRAWN_SECONDS * fps), *(closing[:1] + 1).tolist()])
    if count < _MIN_DRAWN:
        return NotMeasured(why="the fingers close at once")
    joints = np.concatenate([state[:count, :num_arm], info.robot.gripper.joint_position(opening[:count])], axis=1)
    objects = {body.name: np.tile(body.world_from_body.vector(), (count, 1)) for body in info.scene.movable}
    try:
        scene = drawable_scene(info)
        world = RecordedWorld(info.robot, scene, joint_position=joints, object_poses=objects)
        grids = {name: (cells.shape[2], cells.shape[1]) for name, cells in seen.items()}
        beginning = {name: cells[:count] for name, cells in seen.items()}
        frames = frames_to_draw(beginning.values(), world.all_poses[:count])
        drawn = draw(world, scene.cameras, frames, dict.fromkeys(seen, ("color",)), grids)
    except NOT_DRAWABLE as error:
        return NotMeasured(why=f"the scene cannot be drawn here: {error}")
    return {name: compare(cells, drawn[name, "color"], frames) for name, cells in beginning.items()}


def _is_in_the_air(body: Body, bodies: Sequence[Body]) -> bool:
    """Whether nothing is near below it; boxes that do not move stand upright, of other shapes all of a ball counts."""
    x, y, z = body.world_from_body.position
    radius = float(np.linalg.norm(body.shape.extents)) / 2
    tops = [-math.inf]
    for other in bodies:
        off = np.abs(other.world_from_body.position - (x, y, z))
        reach = float(np.linalg.norm(other.shape.extents[:2])) / 2 + radius
        if other is not body and off[:2].max() < reach:
            is_upright = other.shape.kind == "box" and not other.movable
            height = other.shape.extents[2] / 2 if is_upright else float(np.linalg.norm(other.shape.extents))
            tops.append(float(other.world_from_body.position[2]) + height)
    return float(z) - radius > max(tops) + _IN_THE_AIR


Recorded = CheckedEpisode | Dataset
"""What has motions and films, whoever recorded it."""
