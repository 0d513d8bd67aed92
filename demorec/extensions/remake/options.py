"""Flags of `demorec render`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from demorec.core.config import VideoConfig
from demorec.core.errors import check_option, check_seed
from demorec.core.tables import RENDERERS


@dataclass(frozen=True, kw_only=True)
class RerenderOptions:
    """Changes of the new images; all options default to the recorded values."""

    cameras: tuple[str, ...] = ()
    """Names from the recording or `demorec list cameras`, or my_package.my_module:MY_CAMERA (auto: as recorded)."""
    width: int | None = None
    """Image width in pixels (auto: as recorded)."""
    height: int | None = None
    """Image height in pixels (auto: as recorded)."""
    renderer: str | None = None
    """A name from `demorec list renderers` (auto: as recorded)."""
    antialias: bool = True
    """Smooth edges if the recording has them (raster only)."""
    depth: bool = False
    """Add depth images if the recording has none."""
    segmentation: bool = False
    """Add segmentation images if the recording has none."""
    looks: int | None = None
    """Seed of random light, colours and textures (auto: the recorded appearance)."""
    codec: Literal["h264", "av1", "jpeg"] | None = None
    """Codec of the new images (auto: as recorded)."""
    gop: int | None = None
    """Frames from one keyframe to the next (auto: as recorded)."""
    crf: int | None = None
    """Constant rate factor, lower is better (auto: as recorded)."""
    preset: str | None = None
    """Encoder preset (auto: as recorded)."""
    jpeg_quality: int | None = None
    """Quality for --codec jpeg, 1 to 100, higher is better (auto: as recorded)."""

    @property
    def video(self) -> dict[str, Any]:
        """Fields of `VideoConfig` that change."""
        return self._given("codec", "gop", "crf", "preset", "jpeg_quality")

    @property
    def config(self) -> dict[str, Any]:
        """Fields of `GenerateConfig` that change, without `video`."""
        changes = self._given("renderer", "width", "height")
        changes |= {name: True for name in ("depth", "segmentation") if getattr(self, name)}
        changes |= {} if self.antialias else {"antialias": False}
        return changes | ({"cameras": list(self.cameras)} if self.cameras else {})

    def _given(self, *names: str) -> dict[str, Any]:
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    def validate(self) -> None:
        """Raise ConfigError for impossible values."""
        if self.renderer is not None:
            RENDERERS.check_name(self.renderer)
        check_seed("looks", self.looks)
        check_option("width", self.width, 16, 8192, "pixels")
        check_option("height", self.height, 16, 8192, "pixels")
        replace(VideoConfig(), **self.video).validate()
