"""Declaration of the LeRobot datasets that exist already: reading, viewing, checking, editing and repairing them."""

from demorec.core.extension import CommandRow, Extension, KindRow

EXTENSION = Extension(
    name="datasets",
    summary="read, view, edit, repair and compare LeRobot datasets",
    commands={
        "dataset": CommandRow(
            target="demorec.extensions.datasets.command:DatasetCommand", group="edit", limits="reading"
        )
    },
    kinds={
        "dataset": KindRow(
            plural="LeRobot datasets",
            viewer="demorec.extensions.datasets.playback:dataset_episodes",
            describer="demorec.extensions.datasets.describe:describe_dataset",
            digester="demorec.extensions.datasets.inspect:dataset_digest",
            appender="demorec.extensions.datasets.append:start_after",
        )
    },
    file_checks={
        "run_dataset": "demorec.extensions.datasets.file_checks:run_dataset",
        "dataset_sidecar": "demorec.extensions.datasets.file_checks:dataset_sidecar",
    },
    operations={
        "select": "demorec.extensions.datasets.selection:Select",
        "drop": "demorec.extensions.datasets.selection:Drop",
        "trim": "demorec.extensions.datasets.operations:Trim",
        "cut": "demorec.extensions.datasets.operations:Cut",
        "split": "demorec.extensions.datasets.selection:Split",
        "merge": "demorec.extensions.datasets.operations:Merge",
        "rename": "demorec.extensions.datasets.operations:Rename",
        "drop-features": "demorec.extensions.datasets.operations:DropFeatures",
        "set-task": "demorec.extensions.datasets.selection:SetTask",
        "reorder": "demorec.extensions.datasets.selection:Reorder",
        "shuffle": "demorec.extensions.datasets.selection:Shuffle",
        "repair": "demorec.extensions.datasets.operations:Repair",
        "diff": "demorec.extensions.datasets.operations:Diff",
    },
)
