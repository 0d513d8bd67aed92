"""The command line: one file per command, `shared` for common parts, exit codes, errors in one sentence.

Exit codes: 0 success; 1 failure, a failed check, or damaged data; 2 an invalid request (an impossible option, a missing
path, an existing target); 130 interrupted. Modules of this package import heavy libraries inside `run` only, so that
`--help` is fast.
"""

from __future__ import annotations

import logging
import sys
import tempfile
import textwrap
import traceback
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Protocol

from demorec.cli.shared.flags import parse, terminal_width
from demorec.cli.shared.output import PrintableFormatter, say, tell
from demorec.core.errors import DemorecError, MissingDependencyError, OptionError, resource_error
from demorec.core.extension import GROUPS, command_rows, extensions, targets_of
from demorec.core.own_code import own_line
from demorec.core.registry import Registry, nearest_match


class Command(Protocol):
    """A dataclass whose fields are the flags and whose docstring is the help; or a group (`subcommands_of`).

    Only --help-all shows the fields that are `Rare` (`demorec.core.options`).
    A classmethod `defaults(args)`, where there is one, returns the instance whose values are the flags' defaults.
    """

    def run(self) -> int:
        """Run the command and return the exit code."""


COMMANDS: Registry[type[Command]] = Registry(kind="command", rows=targets_of("commands"))


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `demorec`."""
    args = list(sys.argv[1:] if argv is None else argv)
    if args[:1] == ["--version"]:
        sys.exit(_reported("demorec", lambda: _print([f"demorec {version('demorec')}"])))
    sys.exit(_run_named(COMMANDS, args, prog="demorec", about="robot demonstrations you can trust"))


def generate_dataset_main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `generate-dataset`: the same as `demorec generate`."""
    args = list(sys.argv[1:] if argv is None else argv)
    sys.exit(_run(COMMANDS, "generate", args, prog="generate-dataset"))


def _run_named(commands: Registry[type[Command]], args: Sequence[str], *, prog: str, about: str) -> int:
    """Run the command named by the first word; without one, print the program's purpose and list all commands."""
    name = args[0] if args else ""
    if commands is COMMANDS:
        tell(*(f"{prog}: {problem}" for problem in extensions().problems))
    if not name or name.startswith("-"):
        code = _reported(prog, lambda: _print(_overview(commands, prog, about)))
        return code if name in ("-h", "--help") else code or 2
    if name not in commands.rows:
        tell(f"{prog}: Unknown command {name!r}.{nearest_match(name, commands.rows)} See {prog} --help.")
        return 2
    return _run(commands, name, args[1:], prog=f"{prog} {name}")


def _run(commands: Registry[type[Command]], name: str, args: Sequence[str], *, prog: str) -> int:
    try:
        command = commands.load(name)  # may take a while
    except KeyboardInterrupt:
        tell(f"{prog}: interrupted.")
        return 130
    if (subcommands := subcommands_of(command)) is not None:
        return _run_named(subcommands, args, prog=prog, about=command.__doc__ or "")
    return run_command(command, args, prog=prog)


def subcommands_of(command: type[Command]) -> Registry[type[Command]] | None:
    """Commands of a group such as `demorec dataset`, from its class attribute `commands`."""
    found: Registry[type[Command]] | None = getattr(command, "commands", None)
    return found


def run_command(command: type[Command], args: Sequence[str], *, prog: str) -> int:
    """Parse the flags, run the command, and return the exit code."""
    handler = logging.StreamHandler()
    handler.setFormatter(PrintableFormatter())
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    logging.captureWarnings(True)  # so that Python's warnings are formatted, too
    return _reported(prog, lambda: parse(command, args, prog=prog).run())


def _print(lines: Sequence[str]) -> int:
    say(*lines)
    return 0


def _reported(prog: str, run: Callable[[], int]) -> int:
    """Run a part of a program, print its errors as one sentence, and return the exit code."""
    try:
        return run()
    except DemorecError as error:
        tell(f"{prog}: {error.of_flag() if isinstance(error, OptionError) else error}")
        return error.exit_code
    except KeyboardInterrupt:
        tell(f"{prog}: interrupted.")
        return 130
    except BrokenPipeError:  # the reader of the output has closed it
        return 1
    except Exception as error:
        lack = resource_error(error) or _missing_package(error)  # any line may run out of memory or file descriptors
        if lack is None and (line := own_line(error)):
            kind = f"{type(error).__name__}: {error}".rstrip(": ")
            tell(f"{prog}: {kind} (the traceback is in {_keep_traceback()}); raised at {line}")
            return 1
        if lack is None:
            tell(f"{prog}: unexpected {type(error).__name__}, please report it with this file: {_keep_traceback()}")
            return 1
        tell(f"{prog}: {lack}")
        return lack.exit_code


_DISTRIBUTIONS = {
    "rerun": "rerun-sdk",
    "PIL": "pillow",
    "ruamel": "ruamel-yaml",
    "fast_simplification": "fast-simplification",
}
"""Import name -> package name, if they differ."""


def _missing_package(error: Exception) -> DemorecError | None:
    """Return an error for an import of a package that is not installed; None for other errors."""
    if not isinstance(error, ModuleNotFoundError) or not error.name or error.name.startswith("demorec"):
        return None
    name = error.name.partition(".")[0]
    package = _DISTRIBUTIONS.get(name, name)
    return MissingDependencyError("This command", package, f"pip install {package}")


def _keep_traceback() -> str:
    """Write the traceback of the current error and return its path, or its last line if it cannot be written."""
    text = traceback.format_exc()
    try:
        with tempfile.NamedTemporaryFile("w", prefix="demorec-error-", suffix=".txt", delete=False) as file:
            file.write(f"demorec {version('demorec')}, Python {sys.version}\n{' '.join(sys.argv)}\n\n{text}")
        return file.name
    except (OSError, UnicodeError):
        return text.splitlines()[-1]


def _overview(commands: Registry[type[Command]], prog: str, about: str) -> list[str]:
    lines = textwrap.wrap(f"{prog}: {' '.join(about.split())}", terminal_width(), break_on_hyphens=False)
    lines += ["", f"usage: {prog} COMMAND ... (COMMAND --help for more)", ""]
    if commands is not COMMANDS:
        return lines + _summaries(commands, commands.names())
    for group in GROUPS:
        names = [name for name, row in command_rows().items() if row.group == group]
        lines += [f"{group}:", *_summaries(commands, names), ""] if names else []
    return [*lines, "generate-dataset ... is the same as demorec generate ..."]


def _summaries(commands: Registry[type[Command]], names: Sequence[str]) -> list[str]:
    """The first line of each command's help."""
    width = max(10, *map(len, commands.names()))
    lines: list[str] = []
    for name in names:
        summary = (commands.load(name).__doc__ or "").strip().splitlines()[0]
        lines += textwrap.wrap(
            f"{name:<{width}} {summary}",
            terminal_width(),
            initial_indent="  ",
            subsequent_indent=" " * (width + 3),
            break_on_hyphens=False,
        )
    return lines
