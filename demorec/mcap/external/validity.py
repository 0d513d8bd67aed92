"""Whether the description of a collected episode can be worked with at all, be it read from a file or just made."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence

from demorec.core.config import MAX_PIXELS
from demorec.episode.external import Camera, EpisodeInfo, Feature
from demorec.robots.urdf import Urdf

_FEATURE = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z][A-Za-z0-9_]*)*")
_CAMERA = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_RESERVED = ("frames", "tf", "tf_static", "robot_description", "camera", "language")
"""First words of topics that are no feature's."""
_DATASET = ("timestamp", "frame_index", "episode_index", "index", "task_index", "task", "next", "observation.images")
"""What datasets call their own columns."""
_MAX_ELEMENTS = 4096
MAX_FEATURES = 256
MAX_CAMERAS = 64
_MAX_TEXT = 10_000


def what_is_wrong(info: EpisodeInfo) -> list[str]:
    """Everything that makes a description impossible, in words; empty when nothing does."""
    return list(_info(info))


def _info(info: EpisodeInfo) -> Iterator[str]:
    if not 0 <= info.episode_index < 2**31:
        yield f"episode_index is {info.episode_index}, allowed are 0 to {2**31 - 1}"
    if not 1 <= info.fps <= 10_000:
        yield f"fps is {info.fps}, allowed are 1 to 10000"
    if not info.instruction.strip():
        yield "the task text is empty"
    for what, text in (("task text", info.instruction), ("name of the robot", info.robot)):
        if len(text) > _MAX_TEXT or not text.isprintable():
            yield f"the {what} is no single line of at most {_MAX_TEXT} characters"
    if not 1 <= len(info.features) <= MAX_FEATURES or len(info.cameras) > MAX_CAMERAS:
        yield (
            f"there are {len(info.features)} features and {len(info.cameras)} cameras, allowed are 1 to {MAX_FEATURES}"
            f" and up to {MAX_CAMERAS}"
        )
    yield from _unique("features", [feature.name for feature in info.features])
    yield from _unique("cameras", [camera.name for camera in info.cameras])
    joints: frozenset[str] = frozenset()
    links: frozenset[str] = frozenset()
    if info.urdf:
        try:
            urdf = Urdf.parse(info.urdf)
        except ValueError as error:
            yield str(error)
        else:
            joints = frozenset(joint.name for joint in urdf.joints)
            links = frozenset((urdf.root, *(joint.child for joint in urdf.joints)))
    for feature in info.features:
        yield from _feature(feature, joints)
    for camera in info.cameras:
        yield from _camera(camera, links)


def _feature(feature: Feature, joints: frozenset[str]) -> Iterator[str]:
    name = feature.name
    if not _FEATURE.fullmatch(name):
        yield f"a feature is called {name!r}, allowed are words of letters, digits and _, with dots between them"
    if name.partition(".")[0] in _RESERVED or any(name == own or name.startswith(own + ".") for own in _DATASET):
        yield f"a feature is called {name!r}, which is a reserved name"
    count = len(feature.names)
    if not 1 <= count <= _MAX_ELEMENTS:
        yield f"the feature {name!r} has {count} elements, allowed are 1 to {_MAX_ELEMENTS}"
    yield from _unique(f"elements of the feature {name!r}", feature.names)
    for what, words in (("units", feature.units), ("joints", feature.joints)):
        if words and len(words) != count:
            yield f"the feature {name!r} has {count} elements, but {len(words)} {what}"
    named = [joint for joint in feature.joints if joint]
    if unknown := [joint for joint in named if joints and joint not in joints]:
        yield f"the feature {name!r} has joints that the URDF does not have: {', '.join(unknown)}"
    yield from _unique(f"joints of the feature {name!r}", named)


def _camera(camera: Camera, links: frozenset[str]) -> Iterator[str]:
    what = f"the camera {camera.name!r}"
    if not _CAMERA.fullmatch(camera.name):
        yield f"a camera is called {camera.name!r}, allowed are letters, digits and _, beginning with a letter"
    if not (1 <= camera.width <= 8192 and 1 <= camera.height <= 8192 and camera.width * camera.height <= MAX_PIXELS):
        yield f"{what} has {camera.width}x{camera.height} pixels, allowed are 1 to {MAX_PIXELS} in all"
    if camera.intrinsics is not None and len(camera.intrinsics) != 9:
        yield f"{what} has {len(camera.intrinsics)} intrinsics, K has 9"
    if links and camera.mount and camera.mount not in links:
        yield f"{what} is mounted on {camera.mount!r}, which is no link of the URDF"


def _unique(what: str, names: Sequence[str]) -> Iterator[str]:
    for name, count in Counter(names).items():
        if count > 1:
            yield f"{count} {what} are called {name!r}"
        if not name or not name.isprintable() or "," in name:
            yield f"one of the {what} is called {name!r}, allowed are printable characters without commas"
