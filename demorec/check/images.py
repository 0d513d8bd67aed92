"""Check that all images of a recording decode: colour, depth and labels."""

from __future__ import annotations

from collections.abc import Iterator

from demorec.check.base import Fault, NotApplicableError, check, listed
from demorec.check.episode import CheckedEpisode


@check(
    family="files",
    on=("simulated", "external"),
    measures="cameras whose images do not all decode",
    needs="images",
    why="Images are missing or damaged.",
    do="record it again, or leave it out",
    needs_images=True,
)
def images_decode(subject: CheckedEpisode) -> Iterator[Fault]:
    """Decode every image: colour, depth and labels."""
    cameras, wrong = subject.undecoded()
    if not cameras:
        raise NotApplicableError("the recording has no images")
    return listed([f"{camera}: {problem}" for camera, problem in wrong])
