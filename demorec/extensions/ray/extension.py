"""Declaration of the executor on Ray."""

from demorec.core.extension import Extension

EXTENSION = Extension(
    name="ray",
    summary="generate on a Ray cluster: `--executor ray`",
    executors={"ray": "demorec.extensions.ray.on_ray:executor_on_ray"},
)
