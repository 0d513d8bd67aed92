"""The command line: one file per command, `shared` for what they have in common, exit codes, errors as one sentence.

Exit codes: 0 done; 1 it did not work, a check failed, or data are damaged; 2 the request was wrong (an impossible
option, a missing path, a target that is in the way); 130 interrupted.
Modules of this package import heavy libraries inside `run` only, so that `--help` is quick.
"""

from __future__ import annotations

import logging
import sys
import tempfile
import textwrap
import traceback
from collections.abc import Sequence
from importlib.metadata import version
from typing import Protocol

from demorec.cli.shared.flags import parse, terminal_width
from demorec.cli.shared.output import PrintableFormatter, say, tell
from demorec.core.errors import DemorecError, OptionError, resource_error
from demorec.core.registry import Registry, nearest_match


class Command(Protocol):
    """A dataclass whose fields are the flags and whose docstring is the help.

    A classmethod `defaults(args)`, where there is one, returns the instance whose values are the flags' defaults.
    """

    def run(self) -> int:
        """Do it and return the exit code."""


COMMANDS: Registry[type[Command]] = Registry(
    kind="command",
    rows={
        "generate": "demorec.cli.generate:Generate",
        "import": "demorec.cli.import_bags:Import",
        "info": "demorec.cli.info:Info",
        "view": "demorec.cli.view:View",
        "export": "demorec.cli.export:Export",
        "dataset": "demorec.cli.dataset:Dataset",
        "check": "demorec.cli.check:Check",
        "report": "demorec.cli.report:Report",
        "replay": "demorec.cli.replay:Replay",
        "render": "demorec.cli.render:Render",
        "evaluate": "demorec.cli.evaluate:Evaluate",
        "correct": "demorec.cli.evaluate:Correct",
        "recover": "demorec.cli.recover:Recover",
        "list": "demorec.cli.list_rows:ListRows",
    },
)


_LONGEST = 4000
"""Of an error's sentence."""


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `demorec`."""
    args = list(sys.argv[1:] if argv is None else argv)
    name = args[0] if args else ""
    if name and not name.startswith("-"):
        if name not in COMMANDS.rows:
            _fail(f"Unknown command {name!r}.{nearest_match(name, COMMANDS.rows)} See demorec --help.", 2)
        sys.exit(_run(name, args[1:], prog=f"demorec {name}"))
    try:
        say(*([f"demorec {version('demorec')}"] if name == "--version" else _overview()))
    except DemorecError as error:
        _fail(str(error), error.exit_code)
    sys.exit(0 if name in ("-h", "--help", "--version") else 2)


def generate_dataset_main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `generate-dataset`: the same as `demorec generate`."""
    args = list(sys.argv[1:] if argv is None else argv)
    sys.exit(_run("generate", args, prog="generate-dataset"))


def _run(name: str, args: Sequence[str], *, prog: str) -> int:
    try:
        command = COMMANDS.load(name)  # which may take a while
    except KeyboardInterrupt:
        tell(f"{prog}: interrupted.")
        return 130
    return run_command(command, args, prog=prog)


def run_command(command: type[Command], args: Sequence[str], *, prog: str) -> int:
    """Parse the flags, run the command, turn its errors into one sentence and an exit code."""
    handler = logging.StreamHandler()
    handler.setFormatter(PrintableFormatter())
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    logging.captureWarnings(True)  # so that Python's warnings, too, come through the formatter
    try:
        code: int = parse(command, args, prog=prog).run()
        return code
    except DemorecError as error:
        tell(f"{prog}: {_shortened(error.of_flag() if isinstance(error, OptionError) else str(error))}")
        return error.exit_code
    except KeyboardInterrupt:
        tell(f"{prog}: interrupted.")
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except Exception as error:
        lack = resource_error(error)  # memory and files may run out in any line
        if lack is None:
            tell(f"{prog}: unexpected {type(error).__name__}, please report it with this file: {_keep_traceback()}")
            return 1
        tell(f"{prog}: {lack}")
        return lack.exit_code


def _shortened(text: str) -> str:
    """A sentence without its middle where it quotes a file at great length."""
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST * 3 // 4]} ... {text[-_LONGEST // 4 :]}"


def _keep_traceback() -> str:
    """Where the traceback of the error that is being handled was written; its last line, when it cannot be."""
    text = traceback.format_exc()
    try:
        with tempfile.NamedTemporaryFile("w", prefix="demorec-error-", suffix=".txt", delete=False) as file:
            file.write(f"demorec {version('demorec')}, Python {sys.version}\n{' '.join(sys.argv)}\n\n{text}")
        return file.name
    except (OSError, UnicodeError):
        return text.splitlines()[-1]


def _overview() -> list[str]:
    lines = [
        "demorec: robot demonstrations you can trust",
        "",
        "usage: demorec COMMAND ... (COMMAND --help for more)",
        "",
    ]
    for name in COMMANDS.names():
        summary = (COMMANDS.load(name).__doc__ or "").strip().splitlines()[0]
        indent = " " * 13
        lines += textwrap.wrap(
            f"{name:<10} {summary}",
            terminal_width(),
            initial_indent="  ",
            subsequent_indent=indent,
            break_on_hyphens=False,
        )
    lines += ["", "generate-dataset ... is the same as demorec generate ..."]
    return lines


def _fail(message: str, code: int) -> None:
    tell(f"demorec: {message}")
    sys.exit(code)
