"""A teleoperator that reads actions from a file: {"names": [...], "rows": [[...], ...]}; the last row is repeated."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.teleoperators import Teleoperator, TeleoperatorConfig


@TeleoperatorConfig.register_subclass("scripted")
@dataclass(kw_only=True)
class ScriptedConfig(TeleoperatorConfig):  # type: ignore[misc]
    script: Path


class Scripted(Teleoperator):  # type: ignore[misc]
    config_class = ScriptedConfig
    name = "scripted"

    def __init__(self, config: ScriptedConfig) -> None:
        super().__init__(config)
        script = json.loads(config.script.read_text())
        self._names, self._rows, self._next = script["names"], script["rows"], -1

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self._names, float)

    @property
    def feedback_features(self) -> dict[str, Any]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._next >= 0

    def connect(self, calibrate: bool = True) -> None:
        self._next = 0

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass

    def get_action(self) -> dict[str, float]:
        row = self._rows[min(self._next, len(self._rows) - 1)]
        self._next += 1
        return dict(zip(self._names, row, strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        pass

    def disconnect(self) -> None:
        self._next = -1
