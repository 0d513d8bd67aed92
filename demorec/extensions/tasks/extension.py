"""Declaration of further tasks and of object sets."""

from demorec.core.extension import Extension

EXTENSION = Extension(
    name="tasks",
    summary="stack, sort, line up, pick out of a clutter, pick any object",
    tasks={
        "place_in_tray": "demorec.extensions.tasks.pick:PlaceInTray",
        "stack": "demorec.extensions.tasks.cubes:Stack",
        "stack_three": "demorec.extensions.tasks.cubes:StackThree",
        "unstack": "demorec.extensions.tasks.cubes:Unstack",
        "sort_by_color": "demorec.extensions.tasks.pick:SortByColor",
        "line_up": "demorec.extensions.tasks.cubes:LineUp",
        "pick_from_clutter": "demorec.extensions.tasks.pick:PickFromClutter",
        "pick_shapes": "demorec.extensions.tasks.pick:PickShapes",
        "pick_anything": "demorec.extensions.tasks.anything:PickAnything",
        "tutorial": "demorec.extensions.tasks.tutorial:Tutorial",
    },
    objects={
        "household": "demorec.extensions.tasks.catalog:HOUSEHOLD",
        "blocks": "demorec.extensions.tasks.catalog:BLOCKS",
        "cubes": "demorec.extensions.tasks.catalog:CUBES",
    },
)
