"""The options that decide the data (`GenerateConfig`), read from TOML and flags.

Equal configs and seeds give equal episodes, independent of the machine's load, the workers and their order. Options of
execution (workers, executor, output folder) are not part of it.
"""

from __future__ import annotations

import functools
import platform
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from demorec.core.errors import ConfigError, OptionError, check_option, check_seed
from demorec.core.options import Rare
from demorec.core.plain import from_plain
from demorec.core.registry import is_foreign, modules_of
from demorec.episode.variation import PRESET_NAMES, Preset, Ranges

MAX_PIXELS = 16_000_000
MAX_PHYSICS_HZ = 10_000

PRESETS: Mapping[str, tuple[str, ...]] = {
    "h264": (
        "ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow", "placebo",
    ),
    "av1": tuple(str(number) for number in range(14)),
    "jpeg": (),
}  # fmt: skip
"""Codec -> its encoder presets: those of x264 begin with the fastest, those of SVT-AV1 with the slowest."""


@dataclass(frozen=True, kw_only=True)
class VideoConfig:
    """How images are encoded while recording."""

    codec: Literal["h264", "av1", "jpeg"] = "h264"
    """h264: plays everywhere; av1: LeRobot's default, more CPU, larger with a short GOP; jpeg: single images."""
    gop: Rare[int] = 2
    """Frames from one keyframe to the next; 2 is LeRobot's convention for fast random access."""
    crf: Rare[int | None] = None
    """Constant rate factor, lower is better (auto: 23 for h264, 30 for av1)."""
    preset: Rare[str | None] = None
    """Encoder preset (auto: veryfast for h264, 12 for av1); x264's names, or a number from 0 to 13 for av1."""
    jpeg_quality: Rare[int] = 90
    """Quality for --codec jpeg, 1 to 100, higher is better."""

    def validate(self) -> None:
        """Raise ConfigError for impossible values."""
        check_option("gop", self.gop, 1, 600)
        if self.crf is not None:
            check_option("crf", self.crf, 0, 51 if self.codec == "h264" else 63)
        check_option("jpeg_quality", self.jpeg_quality, 1, 100)
        if self.preset is not None and self.preset not in PRESETS[self.codec]:
            allowed = ", ".join(PRESETS[self.codec]) or "none: leave it out"
            raise OptionError("preset", f"is {self.preset!r}, {self.codec} has {allowed}")


@dataclass(frozen=True, kw_only=True)
class GenerateConfig:
    """All options that decide the content of an episode."""

    task: str = "pick_place"
    """Task of the robot: a name from `demorec list tasks`, or my_package.my_module:MyTask."""
    fixed: Rare[bool] = False
    """Use the task's single fixed layout instead of random ones, if it has one."""
    robot: str = "panda"
    """Robot arm: a name from `demorec list robots`, or my_package.my_module:MY_ARM."""
    seed: int = 0
    """Root seed of all randomness."""
    fps: Rare[int] = 30
    """Frames (control steps) per second; must divide the physics rate."""
    physics_hz: Rare[int] = 240
    """Physics steps per second."""
    cameras: tuple[str, ...] = ("front", "wrist")
    """Names from `demorec list cameras`, or my_package.my_module:MY_CAMERA; or "none"."""
    width: int = 224
    """Image width in pixels; even."""
    height: int = 224
    """Image height in pixels; even."""
    renderer: Rare[str] = "raster"
    """A name from `demorec list renderers`."""
    antialias: Rare[bool] = True
    """Smooth edges (raster only)."""
    depth: Rare[bool] = False
    """Record depth images as well."""
    segmentation: Rare[bool] = False
    """Record segmentation images as well."""
    video: VideoConfig = field(default_factory=VideoConfig)
    """Video encoding."""
    variation: Preset = "mild"
    """How much episodes vary besides their layout: none; mild (action noise with clean labels); full (everything)."""
    ranges: Rare[Ranges] = field(default_factory=Ranges)
    """Single ranges that override those of --variation (auto: those of --variation)."""
    objects: tuple[str, ...] = ()
    """Shelves to draw objects from: names from `demorec list objects`, my_module:MY_SHELF, or a folder of .obj and .stl
    files in metres, with a slash: ./my_meshes (auto: the task's own)."""
    object_split: Rare[Literal["all", "train", "eval"]] = "all"
    """train leaves out one shape in five of each kind; eval has only those."""
    sampling: Rare[Literal["random", "sobol", "lhs"]] = "random"
    """How layouts cover the table: independently at random, or evenly by a Sobol sequence or Latin hypercubes."""
    sampling_block: Rare[int] = 50
    """Episodes per Latin hypercube."""
    split: Rare[Literal["all", "train", "eval"]] = "all"
    """train excludes a region and all seeds of eval; eval starts in that region."""
    joint_rate: Rare[Literal["control", "physics"]] = "control"
    """Record joint states once per frame, or at every physics step."""
    max_attempts: Rare[int] = 3
    """Maximum number of scenes to try for an episode."""
    max_episode_seconds: Rare[float] = 60.0
    """Simulated seconds after which an episode counts as failed."""

    def __post_init__(self) -> None:
        if self.cameras == ("none",):
            object.__setattr__(self, "cameras", ())

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules outside demorec that the config names, the user's own and those of extensions.

        A user who writes a config thereby allows them.
        """
        from demorec.core.tables import CAMERAS, OBJECTS, ROBOTS, TASKS

        targets = [TASKS.target(self.task), ROBOTS.target(self.robot)]
        targets += [CAMERAS.target(name) for name in self.cameras]
        targets += [OBJECTS.target(name) for name in self.objects]
        return tuple(module for module in modules_of(targets) if is_foreign(module))

    def check_names(self, allowed: Iterable[str]) -> None:
        """Raise ConfigError if the config names a module that is not allowed.

        Call this on a config read from a recording, a run, a dataset or a policy before using it:
        `demorec.loop.prepare` imports the modules that its plan's config names.

        Args:
            allowed: The user's own modules and packages that may be imported.

        Raises:
            NotAllowedError: It names an object of another module.
        """
        from demorec.core.tables import CAMERAS, OBJECTS, RENDERERS, ROBOTS, TASKS

        allowed = tuple(allowed)
        TASKS.check_name(self.task, allowed)
        ROBOTS.check_name(self.robot, allowed)
        RENDERERS.check_name(self.renderer)
        for name in self.cameras:
            if name == "none":
                raise ConfigError(f"--cameras none excludes other cameras, found {' '.join(self.cameras)}.")
            CAMERAS.check_name(name, allowed)
        for name in self.objects:
            if "/" not in name:  # a folder runs no code
                OBJECTS.check_name(name, allowed)

    def validate(self) -> None:
        """Check all values that can be checked without heavy imports; the config must be the user's own.

        Raises:
            ConfigError: The first impossible value and the allowed ones.
        """
        from demorec.core.registry import check_choice
        from demorec.core.tables import camera_name

        self.check_names(self.modules)
        if len({camera_name(name) for name in self.cameras}) != len(self.cameras):
            raise ConfigError(f"A camera is named twice: {' '.join(self.cameras)}.")
        check_seed("seed", self.seed)
        check_option("physics_hz", self.physics_hz, 60, MAX_PHYSICS_HZ)
        check_option("fps", self.fps, 1, MAX_PHYSICS_HZ)
        if self.physics_hz % self.fps:
            other = _nearest_divisors(self.physics_hz, self.fps)
            raise OptionError(
                "fps", f"is {self.fps}, which does not divide the physics rate of {self.physics_hz} Hz: use {other}."
            )
        for name, value in (("width", self.width), ("height", self.height)):
            check_option(name, value, 16, 8192)
            if value % 2:
                raise OptionError(
                    name, f"is {value}, but yuv420p video needs even sizes: use {value - 1} or {value + 1}."
                )
        if self.width * self.height > MAX_PIXELS:
            raise ConfigError(f"{self.width}x{self.height} is over {MAX_PIXELS} pixels per image.")
        check_choice("variation", self.variation, PRESET_NAMES)
        self.ranges.validate()
        check_option("sampling_block", self.sampling_block, 2, 100_000)
        check_option("max_attempts", self.max_attempts, 1, 100)
        check_option("max_episode_seconds", self.max_episode_seconds, 1.0, 3600.0)
        self.video.validate()


@dataclass(frozen=True, kw_only=True)
class EpisodePlan:
    """One attempt at one episode: everything a worker needs, as plain data that can cross processes."""

    config: GenerateConfig
    episode_index: int
    attempt: int = 0
    versions: Mapping[str, str] | None = None
    """Versions that the run began with; None for the installed ones."""


def deciding_versions(config: GenerateConfig | None = None) -> dict[str, str]:
    """Return package -> version for every package that decides an episode's bits (numba draws, av encodes the images).

    With a config, which must be the user's own, includes the user's modules that it names
    (`demorec.core.own_versions`).

    Raises:
        ConfigError: A module or package cannot be found.
        SceneError: The model of the user's own robot is missing.
    """
    versions = dict(_deciding_versions())
    if config is not None and config.modules:
        from demorec.core.own_versions import own_versions

        versions |= own_versions(config.modules, robot=config.robot)
    return versions


@functools.cache
def _deciding_versions() -> tuple[tuple[str, str], ...]:
    try:
        bullet = version("pybullet")
    except PackageNotFoundError:  # the fork that is installed where PyBullet cannot be compiled (docs/install.md)
        bullet = f"{version('pybullet-arm64')} (pybullet-arm64)"
    return (
        ("demorec", version("demorec")),
        ("pybullet", bullet),
        *((name, version(name)) for name in ("numpy", "numba", "av")),
    )


_X86_LEVELS = {
    "x86-64-v4": {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "x86-64-v3": {"avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"},
    "x86-64-v2": {"cx16", "popcnt", "sse4_1", "sse4_2", "ssse3"},
}
"""Levels of the x86-64 psABI, highest first, with the /proc/cpuinfo flags that distinguish each from the next lower
level.
"""


@functools.cache
def cpu_type() -> str:
    """Return the CPU's architecture and, where known, its level: "x86-64-v3", "aarch64".

    The C library and NumPy select functions by this level, and the selected functions may round differently.
    """
    machine = platform.machine() or "unknown"
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        flags = set(next((line for line in lines if line.startswith("flags")), "").split())
        return next((level for level, needed in _X86_LEVELS.items() if needed <= flags), machine)
    return machine


def read_toml(path: Path) -> dict[str, Any]:
    """Read the tables of a TOML file as plain data; ConfigError if it cannot be read."""
    try:
        return tomllib.loads(path.read_text())
    except OSError as error:
        raise ConfigError(f"The config file cannot be read ({error.strerror}): {path}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"The config file is not valid TOML ({error}): {path}") from error


def parse_config[T](data: dict[str, Any], cls: type[T], *, source: str) -> T:
    """Convert plain data to a config; ConfigError names every invalid key and the closest match of an unknown one."""
    try:
        return from_plain(data, cls)
    except ValueError as error:
        raise ConfigError(f"{source}: {error}.") from error


def _nearest_divisors(rate: int, wanted: int) -> str:
    """Return the divisors of a rate closest to `wanted`, in words: "48 or 60" for 240 and 50."""
    divisors = [n for n in range(1, rate + 1) if rate % n == 0]
    below = [n for n in divisors if n < wanted][-1:]
    return " or ".join(str(n) for n in below + [n for n in divisors if n > wanted][:1])
