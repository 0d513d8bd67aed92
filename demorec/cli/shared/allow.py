"""`--allow`, which several commands have: the modules of the user's own that what they read may import."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from tyro.conf import UseAppendAction, arg

from demorec.core.user_modules import check_allowed

Allow = Annotated[tuple[str, ...], UseAppendAction, arg(metavar="MODULE", help_behavior_hint="(may be given again)")]
"""One module or package each time, since paths may follow."""


def allowed_modules(names: Sequence[str]) -> tuple[str, ...]:
    """What --allow names; ConfigError where that can be no module."""
    check_allowed(names)
    return tuple(names)
