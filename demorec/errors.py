"""The errors that demorec raises on purpose: one tree, each told to the user as one sentence.

A dropped cube is not an error but an `Outcome`; an error means that no trustworthy result could be made.
All arguments go to `super().__init__`, so that errors cross process borders (pickle) unchanged.
"""

from __future__ import annotations


class DemorecError(Exception):
    """Base of the tree; `exit_code` is what the command line returns for it."""

    exit_code = 1


class ConfigError(DemorecError):
    """What the user asked for cannot be: an unknown name, an impossible number, an unusable folder."""

    exit_code = 2


class NotAllowedError(ConfigError):
    """A file names a module from outside of demorec, and the user has not said that it may be run."""


class SceneError(DemorecError):
    """No scene could be laid out or simulated within the given ranges; tried again a bounded number of times."""


class RenderError(DemorecError):
    """A picture cannot be drawn: a shape that no renderer knows, a broken mesh, a missing OpenGL library."""


class RecordingError(DemorecError):
    """A recording cannot be written or read: no MCAP, cut off, damaged, of an unknown format version."""


class ExportError(DemorecError):
    """A dataset cannot be written: recordings that differ, a target in the way, a failed verification."""


class GenerationError(DemorecError):
    """A run cannot go on: a full disk, a vanished folder, workers that die; what is finished stays."""


class MissingDependencyError(DemorecError):
    """An optional package is not installed.

    Args:
        feature: What the user asked for, as the start of a sentence ("The Ray executor").
        package: The package that is missing.
        remedy: What to type to mend it.
    """

    def __init__(self, feature: str, package: str, remedy: str) -> None:
        super().__init__(feature, package, remedy)

    def __str__(self) -> str:
        feature, package, remedy = self.args
        return f"{feature} needs the package {package!r}, which is not installed: {remedy}."
