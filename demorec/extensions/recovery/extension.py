"""Declaration of the recovery of recordings."""

from demorec.core.extension import CommandRow, Extension

EXTENSION = Extension(
    name="recovery",
    summary="recover recordings after a crash",
    commands={
        "recover": CommandRow(target="demorec.extensions.recovery.command:Recover", group="repair", limits="reading")
    },
)
