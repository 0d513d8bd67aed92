"""The line of the user's own code that raised an error."""

from __future__ import annotations

import functools
import linecache
import sysconfig
import traceback
from pathlib import Path

from demorec.core.errors import error_chain

_MAX_CODE = 120
"""Maximum characters of the line that are shown."""


def own_line(error: BaseException) -> str:
    """Find the last line of the user's own files in the traceback of an error: "my_tasks.py:31: goal = goals[3]".

    A file is the user's own unless it belongs to demorec, to Python or to an installed package. The first error in the
    chain counts. Returns "" if there is no such line.
    """
    for cause in reversed(list(error_chain(error))):
        if isinstance(cause, SyntaxError) and cause.filename and _is_own(cause.filename):
            return _shown(cause.filename, cause.lineno or 0)
        frames = [(frame.filename, frame.lineno or 0) for frame in traceback.extract_tb(cause.__traceback__)]
        for file, number in reversed(frames):
            if _is_own(file):
                return _shown(file, number)
    return ""


@functools.cache
def _others_folders() -> tuple[str, ...]:
    """Folders of demorec, Python and installed packages."""
    installed = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    return (str(Path(__file__).parents[1]), *installed)


def _is_own(file: str) -> bool:
    if not Path(file).is_file():  # "<frozen importlib>", "<string>"
        return False
    path = Path(file).absolute()
    return not any(path.is_relative_to(folder) for folder in _others_folders())


def _shown(file: str, number: int) -> str:
    path, here = Path(file).absolute(), Path.cwd()
    name = path.relative_to(here) if path.is_relative_to(here) else path
    linecache.checkcache(file)
    code = linecache.getline(file, number).strip()[:_MAX_CODE]
    return f"{name}:{number}: {code}"
