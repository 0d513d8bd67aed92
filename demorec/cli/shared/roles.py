"""The flags by which commands that read other people's data let the user name features' roles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tyro.conf import UseAppendAction, arg

if TYPE_CHECKING:
    from demorec.episode.roles import NamedRoles

_Features = Annotated[tuple[str, ...], UseAppendAction, arg(metavar="FEATURE")]
_GripperNames = Annotated[tuple[str, ...], UseAppendAction, arg(metavar="NAME")]


@dataclass(frozen=True, kw_only=True)
class RoleFlags:
    """Features whose role the user names, of data that demorec did not simulate."""

    state: _Features = ()
    """Feature that is the robot's state (auto: by its name); given several times, they are joined."""
    action: _Features = ()
    """Feature that is the action (auto: by its name); given several times, they are joined."""
    gripper: _GripperNames = ()
    """Feature, or element of the state, that is a gripper (auto: by its name)."""

    @property
    def named(self) -> NamedRoles:
        """The flags for code that reads the data."""
        from demorec.episode.roles import NamedRoles

        return NamedRoles(state=self.state, action=self.action, gripper=self.gripper)


NamedByFlags = Annotated[RoleFlags, arg(name="")]
