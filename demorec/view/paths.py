"""Entity paths in the Rerun recording, shared by what logs and what lays out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Paths:
    """Paths below a root, "" for an episode alone or "/a" and "/b" for two that are compared."""

    root: str = ""

    @property
    def world(self) -> str:
        """The scene, z up."""
        return f"{self.root}/world"

    @property
    def robot(self) -> str:
        """The robot's base; its links are nested below."""
        return f"{self.world}/robot"

    @property
    def ee_path(self) -> str:
        """One piece of the gripper's path per frame."""
        return f"{self.world}/ee_path"

    def body(self, name: str) -> str:
        """A body of the scene."""
        return f"{self.world}/bodies/{name}"

    def goal(self, name: str) -> str:
        """Where an object shall end."""
        return f"{self.world}/goals/{name}"

    def end(self, name: str) -> str:
        """Where an object ended; not below the goal, whose transform would act on it too."""
        return f"{self.world}/ends/{name}"

    def camera(self, name: str, more: Literal["", "/depth", "/segmentation", "/boxes"] = "") -> str:
        """A camera: its pose, its pinhole and its pictures; or more pictures of it, or boxes around what it sees."""
        return f"{self.world}/cameras/{name}{more}"

    def curves(self, name: str) -> str:
        """Numbers over time."""
        return f"{self.root}/plots/{name.replace(' ', '_')}"

    @property
    def phase(self) -> str:
        """Phases of the motion as states."""
        return f"{self.root}/phase"

    @property
    def events(self) -> str:
        """What happened, as a log."""
        return f"{self.root}/events"

    @property
    def words(self) -> str:
        """What is being done, planned and remembered, in words."""
        return f"{self.root}/words"

    @property
    def summary(self) -> str:
        """The episode in words."""
        return f"{self.root}/summary"
