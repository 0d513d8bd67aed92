"""Declaration of the recorder."""

from demorec.core.extension import Extension

EXTENSION = Extension(
    name="recorder",
    summary="record any robot, simulator or program: `demorec.Recorder`",
    needs=("recovery",),
)
