"""What the user chooses: the part that decides the data (`GenerateConfig`), read from TOML and flags.

Two equal configs and seeds give the same episodes, whatever the machine's load, the workers or the order; how a
run is carried out (workers, executor, output folder) is not in here.
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
"""Codec -> the presets of x264 and SVT-AV1, fastest first and last."""


@dataclass(frozen=True, kw_only=True)
class VideoConfig:
    """How images are encoded while recording."""

    codec: Literal["h264", "av1", "jpeg"] = "h264"
    """h264: plays everywhere; av1: LeRobot's default, more CPU, larger with a short GOP; jpeg: single images."""
    gop: int = 2
    """Frames from one keyframe to the next; 2 is LeRobot's convention for fast random access."""
    crf: int | None = None
    """Constant rate factor, lower is better (auto: 23 for h264, 30 for av1)."""
    preset: str | None = None
    """Encoder preset (auto: veryfast for h264, 12 for av1); x264's names, or a number from 0 to 13 for av1."""
    jpeg_quality: int = 90
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
    """Everything that decides what an episode contains."""

    task: str = "pick_place"
    """What the robot does: a name from `demorec list tasks`, or my_package.my_module:MyTask."""
    fixed: bool = False
    """Use the task's single fixed layout instead of random ones, if it has one (tutorial)."""
    robot: str = "panda"
    """Which arm: a name from `demorec list robots`, or my_package.my_module:MY_ARM."""
    seed: int = 0
    """Root seed of all randomness."""
    fps: int = 30
    """Frames (control steps) per second; must divide the physics rate."""
    physics_hz: int = 240
    """Physics steps per second."""
    cameras: tuple[str, ...] = ("front", "wrist")
    """Names from `demorec list cameras`, or my_package.my_module:MY_CAMERA; or "none"."""
    width: int = 224
    """Image width in pixels; even."""
    height: int = 224
    """Image height in pixels; even."""
    renderer: str = "raster"
    """A name from `demorec list renderers`."""
    antialias: bool = True
    """Smooth edges (raster only)."""
    depth: bool = False
    """Record depth images as well."""
    segmentation: bool = False
    """Record segmentation images as well."""
    video: VideoConfig = field(default_factory=VideoConfig)
    """Video encoding."""
    variation: Preset = "mild"
    """How much episodes vary besides their layout: none; mild (action noise with clean labels); full (everything)."""
    ranges: Ranges = field(default_factory=Ranges)
    """Single ranges that override those of --variation (auto: those of --variation)."""
    objects: tuple[str, ...] = ()
    """Shelves to draw objects from: names from `demorec list objects`, my_module:MY_SHELF, or a folder of .obj and .stl
    files in metres, with a slash: ./my_meshes (auto: the task's own)."""
    object_split: Literal["all", "train", "eval"] = "all"
    """train leaves out one shape in five of each kind; eval has only those."""
    sampling: Literal["random", "sobol", "lhs"] = "random"
    """How layouts cover the table: independently at random, or evenly by a Sobol sequence or Latin hypercubes."""
    sampling_block: int = 50
    """Episodes per Latin hypercube."""
    split: Literal["all", "train", "eval"] = "all"
    """train excludes a region and all seeds of eval; eval starts in that region."""
    joint_rate: Literal["control", "physics"] = "control"
    """Record joint states once per frame, or at every physics step."""
    max_attempts: int = 3
    """How many scenes to try for an episode before giving it up."""
    max_episode_seconds: float = 60.0
    """Simulated seconds after which an episode counts as failed."""

    def __post_init__(self) -> None:
        if self.cameras == ("none",):
            object.__setattr__(self, "cameras", ())

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules outside demorec of what it names, the user's own and those of extensions.

        A config that the user wrote allows them.
        """
        from demorec.core.tables import CAMERAS, OBJECTS, ROBOTS, TASKS

        targets = [TASKS.target(self.task), ROBOTS.target(self.robot)]
        targets += [CAMERAS.target(name) for name in self.cameras]
        targets += [OBJECTS.target(name) for name in self.objects]
        return tuple(module for module in modules_of(targets) if is_foreign(module))

    def check_names(self, allowed: Iterable[str]) -> None:
        """Raise ConfigError unless all that it names may be loaded.

        A config that was read from a recording, a run, a dataset or a policy must pass this before anything is made
        of it: `demorec.loop.prepare` imports what its plan's config names.

        Args:
            allowed: The user's own modules and packages that may be imported.

        Raises:
            NotAllowedError: It names something of another module.
        """
        from demorec.core.tables import CAMERAS, OBJECTS, RENDERERS, ROBOTS, TASKS

        allowed = tuple(allowed)
        TASKS.check_name(self.task, allowed)
        ROBOTS.check_name(self.robot, allowed)
        RENDERERS.check_name(self.renderer)
        for name in self.cameras:
            if name == "none":
                raise ConfigError(f"--cameras none stands alone, found {' '.join(self.cameras)}.")
            CAMERAS.check_name(name, allowed)
        for name in self.objects:
            if "/" not in name:  # a folder runs no code
                OBJECTS.check_name(name, allowed)

    def validate(self) -> None:
        """Check all values that can be judged without loading anything heavy; the config is the user's own words.

        Raises:
            ConfigError: The first impossible value, with what is allowed.
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
            steps = -(-self.physics_hz // self.fps)  # a frame, rounded up
            other = f", or --physics-hz {steps * self.fps}" if steps * self.fps <= MAX_PHYSICS_HZ else ""
            raise OptionError(
                "fps",
                f"is {self.fps}, which does not divide the physics rate of {self.physics_hz} Hz: use "
                f"{_nearest_divisors(self.physics_hz, self.fps)}{other}.",
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
    """One attempt at one episode: all that a worker needs, as plain data that crosses processes."""

    config: GenerateConfig
    episode_index: int
    attempt: int = 0
    versions: Mapping[str, str] | None = None
    """That the run began with; None: whatever is there now."""


def deciding_versions(config: GenerateConfig | None = None) -> dict[str, str]:
    """package -> version, of everything that decides the bits of an episode (numba draws, av codes the images).

    With a config, which is taken for the user's own words, also of the modules of the user's own that it names
    (`demorec.core.own_versions`).

    Raises:
        ConfigError: One of these cannot be found.
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
    except PackageNotFoundError:  # the fork that is installed where nothing can be compiled (docs/install.md)
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
"""Levels of the x86-64 psABI, highest first: the flags of /proc/cpuinfo that tell one from the level below."""


@functools.cache
def cpu_type() -> str:
    """Return the CPU's architecture and, where known, its level: "x86-64-v3", "aarch64".

    The C library and NumPy choose their functions by it, which may round differently.
    """
    machine = platform.machine() or "unknown"
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        flags = set(next((line for line in lines if line.startswith("flags")), "").split())
        return next((level for level, needed in _X86_LEVELS.items() if needed <= flags), machine)
    return machine


def read_toml(path: Path) -> dict[str, Any]:
    """The plain tables of a TOML file; ConfigError when it cannot be read."""
    try:
        return tomllib.loads(path.read_text())
    except OSError as error:
        raise ConfigError(f"The config file cannot be read ({error.strerror}): {path}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"The config file is no valid TOML ({error}): {path}") from error


def parse_config[T](data: dict[str, Any], cls: type[T], *, source: str) -> T:
    """Plain data to a config; ConfigError names every bad key and the nearest match of an unknown one."""
    try:
        return from_plain(data, cls)
    except ValueError as error:
        raise ConfigError(f"{source}: {error}.") from error


def _nearest_divisors(rate: int, wanted: int) -> str:
    """In words, the divisors of a rate next to a wanted one that is none: "48 or 60" of 240 for 50."""
    divisors = [n for n in range(1, rate + 1) if rate % n == 0]
    below = [n for n in divisors if n < wanted][-1:]
    return " or ".join(str(n) for n in below + [n for n in divisors if n > wanted][:1])
