"""The default renderer: a rasteriser on the CPU, compiled with numba, that redraws only what moved.

From visual shapes (`shapes`) to meshes (`mesh`, `mesh_files`, `primitives`, `decimate`, `textures`),
merged into the arrays (`batch`) that the compiled loops read (`kernels`); `stage` holds what the cameras of a step
share, `canvas` one camera's buffers, `view` its image, `renderer` the whole.
"""

from demorec.render.raster.renderer import RasterRenderer, warm_up

__all__ = ["RasterRenderer", "warm_up"]
