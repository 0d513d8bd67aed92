"""Declaration of the core: the abilities of demorec without extensions."""

from __future__ import annotations

from demorec.core.extension import CommandRow, ExporterRow, Extension


def _checks(module: str, *names: str) -> dict[str, str]:
    return {name: f"demorec.check.{module}:{name}" for name in names}


EXTENSION = Extension(
    name="core",
    summary="generate, record, play back, export",
    commands={
        "generate": CommandRow(target="demorec.cli.generate:Generate", group="make"),
        "info": CommandRow(target="demorec.cli.info:Info", group="look", limits="reading"),
        "view": CommandRow(target="demorec.cli.view:View", group="look", limits="reading"),
        "export": CommandRow(target="demorec.cli.export:Export", group="make", limits="reading"),
        "list": CommandRow(target="demorec.cli.list_rows:ListRows", group="look"),
    },
    tasks={"pick_place": "demorec.tasks.pick:PickPlace"},
    robots={
        "panda": "demorec.robots.panda:PANDA",
        "iiwa": "demorec.robots.iiwa:IIWA",
        "so101": "demorec.robots.so101:SO101",
    },
    cameras={
        "front": "demorec.render.cameras:FRONT",
        "wrist": "demorec.render.cameras:WRIST",
        "top": "demorec.render.cameras:TOP",
        "workspace": "demorec.render.cameras:WORKSPACE",
    },
    renderers={
        "raster": "demorec.render.raster:RasterRenderer",
        "tiny": "demorec.sim.renderers:TinyRenderer",
        "egl": "demorec.sim.renderers:EglRenderer",
    },
    exporters={"lerobot": ExporterRow(target="demorec.datasets.lerobot.options:LEROBOT")},
    file_checks={
        **_checks("file", "opens", "checksums", "readable", "complete", "missing_images", "images_decode"),
        **_checks("run", "run_files", "run_complete", "run_agrees"),
    },
)
