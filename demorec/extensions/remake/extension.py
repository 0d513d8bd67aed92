"""Declaration of deep checks, replay and rendering."""

from demorec.core.extension import CommandRow, Extension

EXTENSION = Extension(
    name="remake",
    summary="remake and compare recordings, replay them, render them again",
    commands={
        "replay": CommandRow(target="demorec.extensions.remake.replay_command:Replay", group="look", limits="drawing"),
        "render": CommandRow(target="demorec.extensions.remake.render_command:Render", group="make", limits="drawing"),
    },
    proofs={"remake": "demorec.extensions.remake.deep_check:proofs"},
)
