"""Check that all images of a recording decode: colour, depth and labels."""

from __future__ import annotations

from demorec.check.base import Measurement, check, counted
from demorec.check.episode import CheckedEpisode


@check(
    group="images",
    on=("simulated", "external"),
    measures="cameras whose images do not all decode",
    needs="images",
    needs_images=True,
)
def images_decode(subject: CheckedEpisode) -> Measurement | None:
    """Decode every image: colour, depth and labels."""
    cameras, wrong = subject.undecoded()
    if not cameras:
        return None
    return counted([f"{camera}: {problem}" for camera, problem in wrong], f"{cameras} cameras")
