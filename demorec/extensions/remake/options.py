"""Flags of `demorec render`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
    depth: bool = False
    """Add depth images if the recording has none."""
    segmentation: bool = False
    """Add segmentation images if the recording has none."""
    looks: int | None = None
    """Seed of random light, colours and textures (auto: the recorded appearance)."""

    @property
    def config(self) -> dict[str, Any]:
        """Fields of `GenerateConfig` that change."""
        names = ("renderer", "width", "height", "depth", "segmentation", "cameras")
        values = {name: getattr(self, name) for name in names}
        return {name: list(value) if name == "cameras" else value for name, value in values.items() if value}

    def validate(self) -> None:
        """Raise ConfigError for impossible values."""
        if self.renderer is not None:
            RENDERERS.check_name(self.renderer)
        check_seed("looks", self.looks)
        check_option("width", self.width, 16, 8192, "pixels")
        check_option("height", self.height, 16, 8192, "pixels")
