"""Layout of a LeRobot dataset: paths, schema, and content digest.

The digest is independent of the files' sizes, compression and number. An episode's digest covers its task, its numbers
and the encoded images as stored in the mp4 file; the dataset's covers fps, robot, features and the episodes in order.
Positions in the dataset (`index`, `episode_index`, `task_index`) are excluded, so that an episode keeps its digest when
it moves.
"""

from __future__ import annotations

import hashlib
import json
import re
import reprlib
import string
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from demorec.core.errors import ExportError, describe_error
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.language import TYPES, language_feature
from demorec.datasets.lerobot.paths import INFO_PATH, SIDECAR_DIR
from demorec.episode.element_names import numbers, read_names
from demorec.episode.roles import Column

CODEBASE_VERSION = "v3.0"
"""Format version for writing."""
OLD_VERSIONS = ("v2.0", "v2.1")
"""Further readable versions: one data file per episode, one video file per episode and camera, and tables as JSON
Lines.
"""
MEBIBYTE = 2**20

_CHUNK = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH = f"data/{_CHUNK}.parquet"
EPISODES_PATH = f"meta/episodes/{_CHUNK}.parquet"
VIDEO_PATH = "videos/{video_key}/" + f"{_CHUNK}.mp4"
TASKS_PATH = "meta/tasks.parquet"
STATS_PATH = "meta/stats.json"

SIDECAR_EPISODES_PATH = f"{SIDECAR_DIR}/episodes/{_CHUNK}.parquet"

FeatureType = Literal["float32", "float64", "int64", "bool", "string", "video", "image", "language"]

_ARROW_TYPES = {
    "float32": pa.float32(),
    "float64": pa.float64(),
    "int64": pa.int64(),
    "bool": pa.bool_(),
    "string": pa.string(),
    **{str(kind): kind for kind in (pa.int8(), pa.int16(), pa.int32(), pa.uint8(), pa.uint16(), pa.uint32())},
}
NUMBER_TYPES = tuple(name for name in _ARROW_TYPES if name != "string")
_CODING = (
    "video.codec", "video.pix_fmt", "is_depth_map", "depth_unit", "video.depth_min", "video.depth_max", "video.shift",
    "video.use_log",
)  # fmt: skip
"""Properties that readers assume to be equal in all videos of the dataset."""
_NUM_CHANNELS = (1, 3, 4)
_MOST_DIMENSIONS = 5
"""Maximum dimensions of arrays for which HF datasets has types."""
_IMAGE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
"""Image file in a row, in HF datasets' form."""


@dataclass(frozen=True, kw_only=True)
class DatasetFeature:
    """One entry of `features` in info.json.

    Attributes:
        dtype: LeRobot's type name.
        shape: Shape without the frame dimension; (1,) is a scalar column.
        names: Names of a vector's elements or a camera's dimensions; None if unknown.
        info: The `video.*` entries; cameras only.
        written_names: `names` in info.json, if they are not a list of these names.
        other: Other keys of the entry.
    """

    dtype: FeatureType
    shape: tuple[int, ...]
    names: tuple[str, ...] | None = None
    info: dict[str, Any] | None = None
    written_names: Any = field(default=None, compare=False)
    other: Mapping[str, Any] = field(default_factory=dict, compare=False)

    @property
    def elements(self) -> tuple[str, ...]:
        """Names of a vector's elements, or their numbers if they have no names."""
        return self.names or numbers(self.shape[0])

    @property
    def column(self) -> Column:
        """The feature in the form for finding roles."""
        is_vector = self.is_numeric and len(self.shape) == 1
        return Column(self.dtype, self.elements if is_vector else ())

    @property
    def is_video(self) -> bool:
        """Whether its frames are in mp4 files rather than in the data table."""
        return self.dtype == "video"

    @property
    def is_numeric(self) -> bool:
        """Whether its frames are numeric, with separate statistics."""
        return self.dtype not in ("video", "image", "string", "language")

    @property
    def is_camera(self) -> bool:
        """Whether its frames are images, in mp4 files or in the data table."""
        return self.dtype in ("video", "image")

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of a camera's images, also for v2's channels-first order."""
        height, width = self.shape[1:3] if self._is_channels_first else self.shape[:2]
        return width, height

    @property
    def num_channels(self) -> int:
        """Number of channels of a camera's images."""
        return self.shape[0] if self._is_channels_first else self.shape[2]

    @property
    def _is_channels_first(self) -> bool:
        return self.shape[0] in _NUM_CHANNELS and self.shape[-1] not in _NUM_CHANNELS

    @property
    def is_depth(self) -> bool:
        """Whether its frames are depth images."""
        return bool((self.info or {}).get("is_depth_map"))

    def differences(self, other: DatasetFeature) -> Iterator[tuple[str, Any, Any]]:
        """Yield (name, value, other's value) for differences that prevent rows of both from being in one dataset;
        unknown values count as equal.
        """
        pairs = {name: (getattr(self, name), getattr(other, name)) for name in ("dtype", "shape")}
        if self.is_numeric and None not in (self.names, other.names):
            pairs["elements"] = tuple(", ".join(feature.names or ()) for feature in (self, other))  # type: ignore[assignment]
        if self.is_video:
            mine, theirs = self.info or {}, other.info or {}
            pairs |= {key: (mine[key], theirs[key]) for key in _CODING if key in mine and key in theirs}
        yield from ((name, *values) for name, values in pairs.items() if values[0] != values[1])

    def to_json(self) -> dict[str, Any]:
        """The entry in info.json's form."""
        names = self.written_names
        if names is None and self.names is not None:
            names = list(self.names)
        entry: dict[str, Any] = {"dtype": self.dtype, "shape": list(self.shape), "names": names}
        if self.info is not None:
            entry["info"] = self.info
        return entry | dict(self.other)

    @classmethod
    def from_json(cls, entry: dict[str, Any]) -> DatasetFeature:
        """Inverse of `to_json`, for datasets from any writer."""
        shape, info = entry["shape"], entry.get("info")
        if not isinstance(entry["dtype"], str):
            raise ValueError("a feature without dtype")
        if not isinstance(shape, list) or not 1 <= len(shape) <= 8 or not all(_is_count(n, 1, 1 << 24) for n in shape):
            raise ValueError(f"a feature of shape {reprlib.repr(shape)}")
        if entry["dtype"] == "video" and len(shape) != 3:
            raise ValueError(f"a video of shape {reprlib.repr(shape)}")
        if info is not None and not isinstance(info, dict):
            raise ValueError("the info of a feature is not an object")
        written = entry.get("names")
        names = read_names(written, int(shape[0]) if len(shape) == 1 else len(shape))
        return cls(
            dtype=entry["dtype"],  # type: ignore[arg-type]
            shape=tuple(shape),
            names=names,
            info=info,
            written_names=None if names is not None and written == list(names) else written,
            other={key: value for key, value in entry.items() if key not in _FEATURE_KEYS},
        )


_FEATURE_KEYS = frozenset(("dtype", "shape", "names", "info"))
AUTOMATIC_FEATURES: dict[str, DatasetFeature] = {
    "timestamp": DatasetFeature(dtype="float32", shape=(1,)),
    **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), DatasetFeature(dtype="int64", shape=(1,))),
}
"""Automatic features: last in every dataset, filled in by the writer."""
LANGUAGE_FEATURE = DatasetFeature(dtype="language", shape=(1,))
"""Feature of each of LeRobot's language columns."""


@dataclass(frozen=True, kw_only=True)
class FilePosition:
    """Position in the numbered files: chunk folder, then file in it."""

    chunk: int = 0
    file: int = 0

    def next(self, chunks_size: int) -> FilePosition:
        """The next file; a chunk folder holds `chunks_size` files."""
        if self.file >= chunks_size - 1:
            return FilePosition(chunk=self.chunk + 1, file=0)
        return replace(self, file=self.file + 1)

    def path(self, template: str, video_key: str = "") -> str:
        """The path within the dataset."""
        return template.format(chunk_index=self.chunk, file_index=self.file, video_key=video_key)


@dataclass(frozen=True, kw_only=True)
class DatasetInfo:
    """Content of meta/info.json.

    Path templates have v3.0's placeholders: in an older dataset `file_index` is the episode's number.

    Attributes:
        features: All features; standard ones are added if the file does not list them.
        other: Other entries of the file.
        version: Format of the dataset.
        unlisted: The added features.
    """

    fps: int
    features: dict[str, DatasetFeature]
    robot_type: str | None = None
    total_episodes: int = 0
    total_frames: int = 0
    total_tasks: int = 0
    chunks_size: int = 1000
    data_files_size_in_mb: float = 100
    video_files_size_in_mb: float = 200
    data_path: str = DATA_PATH
    video_path: str | None = VIDEO_PATH
    other: dict[str, Any] = field(default_factory=dict)
    version: str = CODEBASE_VERSION
    unlisted: tuple[str, ...] = ()

    @property
    def is_old(self) -> bool:
        """Whether its format is older than v3.0."""
        return self.version in OLD_VERSIONS

    @property
    def video_keys(self) -> tuple[str, ...]:
        """Names of the camera features."""
        return tuple(name for name, feature in self.features.items() if feature.is_video)

    def to_json(self) -> str:
        """Text of the file."""
        data = {
            "codebase_version": CODEBASE_VERSION,
            "fps": self.fps,
            "features": {name: feature.to_json() for name, feature in self.features.items()},
            **{name: getattr(self, name) for name in _PLAIN_FIELDS},
            "video_path": self.video_path if self.video_keys else None,
            "robot_type": self.robot_type,
            "splits": {"train": f"0:{self.total_episodes}"},
            **self.other,
        }
        return json.dumps(data, indent=4, ensure_ascii=False) + "\n"

    @classmethod
    def load(cls, root: Path) -> DatasetInfo:
        """Read it from a dataset's folder. Raises ExportError if info.json is missing, or has another version of the
        format.
        """
        try:
            return cls.from_json(read_json(root / INFO_PATH), root)
        except OSError as error:
            raise ExportError(
                f"Not a LeRobot dataset, {INFO_PATH} cannot be read ({error.strerror}): {root}"
            ) from error
        except ValueError as error:
            raise ExportError(f"{INFO_PATH} of the dataset is damaged ({describe_error(error)}): {root}") from error

    @classmethod
    def from_json(cls, data: Any, root: Path) -> DatasetInfo:
        """Parse the file's content, which is modified; errors as in `load`."""
        try:
            version = data.pop("codebase_version")
            if version not in (CODEBASE_VERSION, *OLD_VERSIONS):
                found = f"The dataset has format {reprlib.repr(version).strip("'")}"
                raise ExportError(f"{found}, supported are {', '.join(OLD_VERSIONS)} and {CODEBASE_VERSION}: {root}")
            data.pop("splits", None)
            features = {name: DatasetFeature.from_json(entry) for name, entry in data.pop("features").items()}
            unlisted = tuple(name for name in AUTOMATIC_FEATURES if name not in features)
            features |= {name: AUTOMATIC_FEATURES[name] for name in unlisted}
            known = {name: data.pop(name) for name in list(data) if name in _INFO_FIELDS}
            if version in OLD_VERSIONS:
                known |= {name: _as_new(known[name]) for name in ("data_path", "video_path") if known.get(name)}
            info = cls(features=features, other=data, version=version, unlisted=unlisted, **known)
            info._check()
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ExportError(f"{INFO_PATH} of the dataset is damaged ({describe_error(error)}): {root}") from error
        return info

    def _check(self) -> None:
        for name in ("fps", "total_episodes", "total_frames", "total_tasks", "chunks_size"):
            if not _is_count(getattr(self, name), 0 if name.startswith("total") else 1, 1 << 40):
                raise ValueError(f"{name} is {reprlib.repr(getattr(self, name))}")
        for size in (self.data_files_size_in_mb, self.video_files_size_in_mb):
            if isinstance(size, bool) or not isinstance(size, int | float) or not 0 < size < 1e9:
                raise ValueError(f"files of {reprlib.repr(size)} MB")
        if self.robot_type is not None and not isinstance(self.robot_type, str):
            raise ValueError(f"robot_type is {reprlib.repr(self.robot_type)}")
        for name in self.features:
            if not name.isprintable() or name.startswith("/") or ".." in name.split("/"):
                raise ValueError(f"a feature is called {name[:80]!r}")
        for template in (self.data_path, self.video_path):
            if template is not None:
                _check_template(template)


def _as_new(template: object) -> object:
    if not isinstance(template, str):
        return template
    return template.replace("{episode_chunk", "{chunk_index").replace("{episode_index", "{file_index")


def _is_count(value: object, low: int, high: int) -> bool:
    """Whether a value is an integer from `low` to `high`; other writers store some as 30.0."""
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high and value == int(value)
    )


def _check_template(template: object) -> None:
    """Raise ValueError unless a path template stays inside the dataset and uses known placeholders."""
    if not isinstance(template, str) or not template.isprintable():
        raise ValueError("a path that is not text")
    parts = Path(template).parts
    if Path(template).is_absolute() or ".." in parts:
        raise ValueError(f"the path {template[:80]!r} leads out of the dataset")
    for _, name, kind, conversion in string.Formatter().parse(template):
        if name is not None and (name not in _PLACEHOLDERS or conversion or not re.fullmatch(r"(0?\dd)?", kind or "")):
            raise ValueError(f"the path {template[:80]!r} has an unknown placeholder")


_PLACEHOLDERS = ("chunk_index", "file_index", "video_key")
_PLAIN_FIELDS = (
    "total_episodes", "total_frames", "total_tasks", "chunks_size", "data_files_size_in_mb", "video_files_size_in_mb",
    "data_path",
)  # fmt: skip
_INFO_FIELDS = frozenset(("fps", "robot_type", "video_path", *_PLAIN_FIELDS))


def video_info(size: tuple[int, int], codec: str, pixels: str, fps: int, channels: int = 3) -> dict[str, Any]:
    """The first entries of a camera feature's `info`; `size` is (width, height)."""
    return {
        "video.height": size[1],
        "video.width": size[0],
        "video.codec": codec,
        "video.pix_fmt": pixels,
        "video.fps": fps,
        "video.channels": channels,
        "has_audio": False,
    }


_ENCODER_INFO = ("video.g", "video.crf", "video.preset", "video.fast_decode", "video.extra_options")


def merged_video_info(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """`a` without the encoder settings that differ in `b` (null, as when LeRobot merges datasets)."""
    unknown: dict[str, Any] = {"video.extra_options": {}}
    return {
        key: value if key not in _ENCODER_INFO or b.get(key) == value else unknown.get(key) for key, value in a.items()
    }


def data_schema(features: dict[str, DatasetFeature]) -> pa.Schema:
    """Schema of the data files, with the metadata for HF datasets' types."""
    columns = {name: _column(name, feature) for name, feature in features.items() if not feature.is_video}
    described = {name: description for name, (_, description) in columns.items()}
    metadata = {"huggingface": json.dumps({"info": {"features": described}})}
    return pa.schema([pa.field(name, kind) for name, (kind, _) in columns.items()], metadata)


def _column(name: str, feature: DatasetFeature) -> tuple[pa.DataType, Mapping[str, Any]]:
    """Arrow type of a column, and its type for HF datasets."""
    dtype, shape = feature.dtype, feature.shape
    if dtype == "language" and name in TYPES:
        return TYPES[name], language_feature(name)
    if dtype == "image":
        return _IMAGE, {"_type": "Image"}
    if dtype not in _ARROW_TYPES or len(shape) > _MOST_DIMENSIONS:
        raise ExportError(
            f"The feature {name!r} has dtype {dtype} and shape {shape}, which demorec cannot write: export into a new "
            "folder."
        )
    kind, value = _ARROW_TYPES[dtype], {"dtype": dtype, "_type": "Value"}
    if shape == (1,):
        return kind, value
    if len(shape) == 1:
        listed = pa.list_(pa.field("element", kind), shape[0])
        return listed, {"feature": value, "length": shape[0], "_type": "List"}
    for _ in shape:
        kind = pa.list_(kind)
    return kind, {"shape": list(shape), "dtype": dtype, "_type": f"Array{len(shape)}D"}


_POSITIONS = frozenset(("index", "episode_index", "task_index"))


def episode_digest(task: str, columns: Mapping[str, NDArray[Any]], videos: Mapping[str, str]) -> str:
    """SHA-256 (hex) of one episode.

    Args:
        task: Instruction.
        columns: Feature -> (T,) or (T, D); may include the positions.
        videos: Camera feature -> SHA-256 (hex) of its concatenated images.
    """
    result = hashlib.sha256(json.dumps(task).encode())
    for name in sorted(columns):
        if name not in _POSITIONS:
            values = np.ascontiguousarray(columns[name])
            flat = values.reshape(len(values), -1)
            result.update(f"{name} {values.dtype.str} {flat.shape}".encode())
            result.update(flat.tobytes())
    for name in sorted(videos):
        result.update(f"{name} {videos[name]}".encode())
    return result.hexdigest()


def combined_digest(info: DatasetInfo, episodes: Iterable[str]) -> str:
    """SHA-256 (hex) of a dataset, from the digests of its episodes in order."""
    features = {name: [item.dtype, list(item.shape), item.names] for name, item in sorted(info.features.items())}
    result = hashlib.sha256(json.dumps([info.fps, info.robot_type, features]).encode())
    for episode in episodes:
        result.update(episode.encode())
    return result.hexdigest()
