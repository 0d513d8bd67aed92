"""Declaration of the doctor, which checks data from any source."""

from demorec.core.extension import CommandRow, Extension

EXTENSION = Extension(
    name="doctor",
    summary="judge datasets, runs and recordings before training",
    needs=("datasets", "remake"),
    commands={
        "check": CommandRow(
            target="demorec.extensions.doctor.check_command:CheckCommand",
            group="judge",
            limits="reading",
            drawing_flags=("--deep",),
        ),
        "explain": CommandRow(target="demorec.extensions.doctor.check_command:Explain", group="judge"),
    },
    columns=dict.fromkeys(("verdict", "score"), "demorec.extensions.doctor.from_dataset:judged_columns"),
    rankings={"score": "demorec.extensions.doctor.from_dataset:by_score"},
    lists={"checks": "demorec.extensions.doctor.check_command:check_rows"},
)
