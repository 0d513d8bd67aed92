"""PyBullet's own CPU renderer (TinyRenderer): slow, hard shadows, always there.

It samples half a pixel up and to the left of the pixels' centres, and its depth is about a millimetre too small at a
metre. Both are left as they are: the pictures are PyBullet's.
"""

from __future__ import annotations

from demorec.sim.renderers.client_renderer import ClientRenderer


class TinyRenderer(ClientRenderer):
    """Draws on the CPU, in a client without a window."""

    constant = "ER_TINY_RENDERER"
