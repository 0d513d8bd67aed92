"""A camera that always sees the same grey."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.cameras import Camera, CameraConfig


@CameraConfig.register_subclass("still")
@dataclass(kw_only=True)
class StillConfig(CameraConfig):  # type: ignore[misc]
    pass


class Still(Camera):  # type: ignore[misc]
    def __init__(self, config: StillConfig) -> None:
        super().__init__(config)
        self._is_connected = False

    @property
    def is_connected(self) -> bool:
        return self._is_connected

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        return []

    def connect(self, warmup: bool = True) -> None:
        self._is_connected = True

    def read(self) -> Any:
        return np.full((self.height, self.width, 3), 128, np.uint8)

    def async_read(self, timeout_ms: float = 200) -> Any:
        return self.read()

    def read_latest(self, max_age_ms: int = 500) -> Any:
        return self.read()

    def disconnect(self) -> None:
        self._is_connected = False
