"""Make the files of `demorec.precompiled` anew, after a change of their sources or of Numba's version.

    make precompiled

They hold what Numba's front end makes of our functions, before any optimisation: LLVM's intermediate code for no CPU in
particular. So the same sources give the same files on every machine of a type.
"""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Any

NO_CPU = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
"""Of Numba's settings, which it reads when it is loaded."""


def exercise_raster() -> None:
    """Call every kernel of the rasteriser with the types that scenes have."""
    from demorec.render.raster.rehearsal import rehearse

    rehearse()


def exercise_kinematics() -> None:
    """Call all that an arm of two joints can do."""
    import numpy as np

    from demorec.geometry import Pose
    from demorec.scene.kinematics import ArmKinematics

    arm = ArmKinematics(
        origins=np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2]]),
        rotations=np.array([np.eye(3), np.eye(3)]),
        axes=np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]),
        tool=np.array([0.0, 0.0, 0.2]),
        tool_rotation=np.array(Pose().rotation),
        lower=np.array([-1.0, -1.0]),
        upper=np.array([1.0, 1.0]),
    )
    start, goal = np.zeros(2), np.array([0.1, 0.2])
    poses = arm.forward(start), arm.forward(goal)
    arm.inverse(poses[1], start=start)
    arm.straight_path(
        start=start, goal=goal, base_from_start=poses[0], base_from_goal=poses[1], fractions=np.array([0.5])
    )


def leave_out_folders() -> None:
    """From now on, code that can raise an error names Numba's file without the folders of this machine."""
    from numba.core.callconv import CPUCallConv

    build = CPUCallConv.build_excinfo_struct

    def build_without_folders(convention: Any, *arguments: Any) -> tuple[Any, Any, Any]:
        error, error_arguments, place = build(convention, *arguments)
        if place is not None:
            function, file, line = place
            place = function, Path(file).name, line
        return error, error_arguments, place

    CPUCallConv.build_excinfo_struct = build_without_folders


def note_libraries() -> dict[Any, tuple[bytes, list[Any]]]:
    """From now on, each library that Numba completes: its code before optimisation, and what it is linked to."""
    from numba.core.codegen import JITCodeLibrary

    noted: dict[Any, tuple[bytes, list[Any]]] = {}
    finalize = JITCodeLibrary.finalize

    def note(library: Any) -> None:
        noted[library] = library._final_module.as_bitcode(), list(dict.fromkeys(library._linking_libraries))
        finalize(library)

    JITCodeLibrary.finalize = note
    return noted


def write(bundle: Any, noted: dict[Any, tuple[bytes, list[Any]]]) -> None:
    """Write a bundle's file from what Numba has compiled in this process."""
    from numba.core.serialize import dumps

    from demorec.precompiled import ABOUT, LIBRARIES

    libraries: list[tuple[bytes, tuple[int, ...]]] = []
    numbers: dict[Any, int] = {}

    def number_of(library: Any) -> int:
        if library not in numbers:
            bitcode, linked = noted[library]
            others = tuple(number_of(other) for other in linked)
            numbers[library] = len(libraries)
            libraries.append((bitcode, others))
        return numbers[library]

    members: dict[str, bytes] = {ABOUT: json.dumps(bundle.about(), indent=2).encode()}
    for dispatcher in bundle.dispatchers:
        if dispatcher.targetoptions.get("forceinline"):
            continue  # part of all that call it
        versions = {}
        for types, compiled in dispatcher.overloads.items():
            _, *rest = compiled._reduce()
            rest[5] = ""  # the annotated source, which names the file's place on this machine
            versions[types] = (number_of(compiled.library), *rest)
        members[dispatcher.py_func.__qualname__] = dumps(versions)
        print(f"{bundle.path.name}: {dispatcher.py_func.__qualname__}, {len(versions)} type(s) of arguments")
    members[LIBRARIES] = dumps(libraries)
    with zipfile.ZipFile(bundle.path, "w") as file:
        for name, content in members.items():  # without the time of day: equal contents give equal files
            file.writestr(zipfile.ZipInfo(name), content, compress_type=zipfile.ZIP_DEFLATED, compresslevel=9)


def main() -> None:
    """Make all files."""
    os.environ.update(NO_CPU)
    with tempfile.TemporaryDirectory() as folder:
        os.environ |= {"DEMOREC_CACHE": folder, "NUMBA_CACHE_DIR": folder}
        from demorec.render.raster.kernels.jit import BUNDLE as RASTER
        from demorec.scene.kinematics_kernels import BUNDLE as KINEMATICS

        leave_out_folders()
        noted = note_libraries()
        for bundle, exercise in ((RASTER, exercise_raster), (KINEMATICS, exercise_kinematics)):
            bundle.fits = False
            exercise()
            write(bundle, noted)


if __name__ == "__main__":
    main()
