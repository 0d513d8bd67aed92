"""What the checks of any episode need of a recording or a dataset."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Protocol

from numpy.typing import NDArray

from demorec.check.evidence import Motions
from demorec.check.films import CameraFilms


class Episodes(Protocol):
    """A recording, or a dataset with all its episodes."""

    @property
    def motions(self) -> Motions:
        """Of every episode that has a state."""

    @property
    def films(self) -> Mapping[str, CameraFilms]:
        """Camera -> its colour images in each episode."""

    def numbers(self) -> Iterator[tuple[str, NDArray[Any]]]:
        """(name, (T, ...) table) of all floating-point numbers."""

    def undecoded(self) -> Iterator[tuple[str, str]]:
        """(camera, problem) of every camera whose images do not all decode, with all kinds of images."""
