"""Declaration of language, progress and bounding boxes."""

from demorec.core.extension import Extension, ExtraFilesRow

EXTENSION = Extension(
    name="language",
    summary="language columns, progress and bounding boxes of exported episodes",
    statements=dict.fromkeys(
        ("subtask", "plan", "memory", "motion", "task_aug"),
        "demorec.extensions.language.statements:episode_statements",
    ),
    extra_files={
        "progress": ExtraFilesRow(
            target="demorec.extensions.language.progress:ProgressFile",
            help="Add the progress of each frame (0 to 1), for LeRobot's sample weighting.",
        ),
        "boxes": ExtraFilesRow(
            target="demorec.extensions.language.boxes:BoxFiles",
            help="Write bounding boxes of visible objects next to the dataset, in COCO's format (for recordings with "
            "segmentation).",
        ),
    },
)
