"""What is done once on a machine, before several processes draw."""

from __future__ import annotations


def warm_up_renderer(renderer: str) -> None:
    """Do what a renderer needs once on a machine, before several processes that use it start: compiling, for raster."""
    if renderer == "raster":
        from demorec.render.raster import warm_up

        warm_up()
