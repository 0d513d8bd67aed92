"""Declaration of environments, evaluation and correction."""

from demorec.core.extension import CommandRow, Extension

EXTENSION = Extension(
    name="policies",
    summary="Gymnasium environments, evaluation of policies, corrections by the expert",
    commands={
        "evaluate": CommandRow(target="demorec.extensions.policies.command:Evaluate", group="learn"),
        "correct": CommandRow(target="demorec.extensions.policies.command:Correct", group="learn"),
    },
)
