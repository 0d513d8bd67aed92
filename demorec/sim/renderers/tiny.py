"""PyBullet's own CPU renderer (TinyRenderer): slow, hard shadows, always there.

It samples half a pixel up and to the left of the pixels' centres, and its depth is about a millimetre too small at a
metre. Both are left as they are: the pictures are PyBullet's.
"""

from __future__ import annotations

from typing import Any

from demorec.sim.client import connect
from demorec.sim.renderers.client_renderer import ClientRenderer


class TinyRenderer(ClientRenderer):
    """Draws on the CPU, in a client without a window."""

    def _connect(self) -> Any:
        return connect()

    def _disconnect(self, client: Any) -> None:
        client.disconnect()

    def _renderer_flag(self, client: Any) -> int:
        return int(client.ER_TINY_RENDERER)
