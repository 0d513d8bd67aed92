"""The default renderer: a rasteriser on the CPU, compiled with numba, that redraws only what moved.

Visual shapes (`shapes`) become meshes (`mesh`, `mesh_files`, `primitives`, `decimate`, `textures`), merged into the
arrays (`batch`) that the compiled loops read (`kernels`). `stage` holds the state that cameras share in a step, `view`
one camera's buffers and images; `renderer` connects them.
"""

from demorec.render.raster.renderer import RasterRenderer, warm_up

__all__ = ["RasterRenderer", "warm_up"]
