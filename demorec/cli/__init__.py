"""The command line: one file per command, exit codes, errors as one sentence.

Exit codes: 0 done; 1 it did not work (or a check failed); 2 the request was wrong; 130 interrupted.
Modules of this package import heavy libraries inside `run` only, so that `--help` is quick.
"""

from __future__ import annotations

import inspect
import logging
import sys
import tempfile
import traceback
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from types import NoneType
from typing import Any, Protocol, cast, get_args

import tyro

from demorec.cli.output import PrintableFormatter, say, tell
from demorec.errors import DemorecError
from demorec.registry import Registry, nearest_match
from demorec.text import printable


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
        "info": "demorec.cli.info:Info",
        "view": "demorec.cli.view:View",
        "export": "demorec.cli.export:Export",
        "check": "demorec.cli.check:Check",
        "replay": "demorec.cli.replay:Replay",
        "render": "demorec.cli.render:Render",
        "evaluate": "demorec.cli.evaluate:Evaluate",
        "reproduce": "demorec.cli.reproduce:Reproduce",
        "recover": "demorec.cli.recover:Recover",
        "list": "demorec.cli.list_rows:ListRows",
    },
)


_flag_types = tyro.constructors.ConstructorRegistry()


@_flag_types.primitive_rule
def _optional_value(
    info: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    """`--workers INT` with auto for None, where tyro would show `--workers {None}|INT`."""
    kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
    if NoneType not in get_args(info.type) or len(kinds) != 1 or kinds[0] not in (int, float, str, Path):
        return None
    kind = kinds[0]
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=lambda words: None if words[0] == "auto" else kind(words[0]),
        is_instance=lambda value: value is None or isinstance(value, kind),
        str_from_instance=lambda value: ["auto" if value is None else str(value)],
    )


@_flag_types.primitive_rule
def _optional_range(
    info: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    """`--cube-mass LOW HIGH` with auto for None, where tyro would show `--cube-mass {None}|{FLOAT FLOAT}`."""
    kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
    if NoneType not in get_args(info.type) or kinds not in ([tuple[int, int]], [tuple[float, float]]):
        return None
    kind = get_args(kinds[0])[0]

    def parse(words: list[str]) -> tuple[Any, ...] | None:
        if words == ["auto"]:
            return None
        if len(words) != 2:
            raise ValueError("two numbers are needed, LOW and HIGH, or auto")
        return tuple(kind(word) for word in words)

    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=(1, 2),
        metavar="LOW HIGH",
        instance_from_str=parse,
        is_instance=lambda value: value is None or (isinstance(value, tuple) and len(value) == 2),
        str_from_instance=lambda value: ["auto"] if value is None else [str(number) for number in value],
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `demorec`."""
    args = list(sys.argv[1:] if argv is None else argv)
    name = args[0] if args else ""
    if name and not name.startswith("-"):
        if name not in COMMANDS.rows:
            _fail(f"Unknown command {name!r}.{nearest_match(name, COMMANDS.rows)} See demorec --help.", 2)
        sys.exit(run_command(COMMANDS.load(name), args[1:], prog=f"demorec {name}"))
    if name == "--version":
        say(f"demorec {version('demorec')}")
        return
    say(*_overview())
    sys.exit(0 if name in ("-h", "--help") else 2)


def generate_dataset_main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `generate-dataset`: the same as `demorec generate`."""
    args = list(sys.argv[1:] if argv is None else argv)
    sys.exit(run_command(COMMANDS.load("generate"), args, prog="generate-dataset"))


def run_command(command: type[Command], args: Sequence[str], *, prog: str) -> int:
    """Parse the flags, run the command, turn its errors into one sentence and an exit code."""
    handler = logging.StreamHandler()
    handler.setFormatter(PrintableFormatter("%(levelname)s: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    logging.captureWarnings(True)  # so that Python's warnings, too, come through the formatter
    try:
        return parse(command, args, prog=prog).run()
    except DemorecError as error:
        tell(f"{prog}: {error}")
        return error.exit_code
    except KeyboardInterrupt:
        tell(f"{prog}: interrupted.")
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except Exception as error:
        tell(f"{prog}: unexpected {type(error).__name__}, please report it with this file: {_keep_traceback()}")
        return 1


def parse(command: type[Command], args: Sequence[str], *, prog: str) -> Command:
    """The command with its flags; SystemExit for --help and for flags that it does not have."""
    shown = [printable(arg) for arg in args]
    try:
        return _parse(command, args, prog=prog, say_why=shown == list(args))
    except SystemExit as end:
        if shown != list(args) and end.code:
            # tyro repeats what it does not understand as it is: it is asked once more, with all of it spelt out.
            _parse(command, shown, prog=prog, say_why=True)
            tell(f"{prog}: the flags are wrong, see --help.")
        raise


def _parse(command: type[Command], args: Sequence[str], *, prog: str, say_why: bool) -> Command:
    find_defaults = getattr(command, "defaults", None)
    with _flag_types:
        parsed = tyro.cli(
            cast(Any, command),
            args=args,
            prog=prog,
            description=inspect.cleandoc(command.__doc__ or ""),
            default=tyro.MISSING_NONPROP if find_defaults is None else find_defaults(args),
            config=(tyro.conf.OmitArgPrefixes,),
            console_outputs=say_why or "-h" in args or "--help" in args,
        )
    return cast(Command, parsed)


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
        lines.append(f"  {name:<10} {summary}")
    lines += ["", "generate-dataset ... is demorec generate ..."]
    return lines


def _fail(message: str, code: int) -> None:
    tell(f"demorec: {message}")
    sys.exit(code)
