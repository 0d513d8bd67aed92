"""Turn the fields of a command into flags, and lay out its help.

tyro renders the help by these rules: optional values show only their type, a default is shown only if it is a value,
and lines are wrapped at the terminal's width.
"""

from __future__ import annotations

import codecs
import dataclasses
import inspect
import io
import math
import re
import shutil
import sys
import textwrap
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import tyro
from tyro.conf import Positional as Positional
from tyro.conf import UseAppendAction
from tyro.conf import arg as arg
from tyro.constructors import (
    MISSING_NONPROP,
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructTypeInfo,
)

from demorec.cli.shared.output import say, tell
from demorec.core.errors import ConfigError
from demorec.core.options import RARE
from demorec.core.registry import is_module_name, split_name
from demorec.core.replacing import check_targets
from demorec.core.text import printable

FLAG_TYPES = ConstructorRegistry()

_HOME = re.compile(r"^(--[\w-]+=|)~(?=/|$)")
_NARROWEST = 40
"""Minimum columns; a narrower terminal wraps lines itself, like tyro's table of flags."""
_UNWRITABLE = ("Cc", "Cs", "Zl", "Zp")
"""Unicode categories of control characters, bytes that are not UTF-8, and line and paragraph separators."""
_HELP_ALL = "--help-all"
_hidden: set[str] | None = None
"""Fields that the current help leaves out; None if it shows all."""
_HINTED = object()
"""Marks a type that tyro's own rule handles."""


def terminal_width() -> int:
    """Columns of the terminal, or COLUMNS, or 80."""
    return max(_NARROWEST, shutil.get_terminal_size().columns)


def parse(command: type[Any], args: Sequence[str], *, prog: str) -> Any:
    """Parse the flags into an instance of the command; `command.defaults(args)`, if it exists, has their defaults.

    Raises:
        SystemExit: 0 after --help, 2 after reporting a wrong flag.
    """
    defaults = command.defaults(args) if hasattr(command, "defaults") else MISSING_NONPROP
    # bash does not expand ~ within quotes and in --out=~/new
    args = [_HOME.sub(lambda found: f"{found[1]}{Path.home()}", word) for word in args]
    asks_for_help = bool({"-h", "--help", _HELP_ALL} & set(args))
    hides = asks_for_help and _HELP_ALL not in args
    # tyro draws its boxes as the encoding allows, but recognises UTF-8 in one spelling only.
    encoding = codecs.lookup(sys.stdout.encoding or "utf-8").name
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors="backslashreplace") for _ in range(2))
    try:
        with FLAG_TYPES, redirect_stdout(out), redirect_stderr(err), _hiding(hides) as hidden:
            parsed = tyro.cli(
                command,
                args=["--help"] if asks_for_help else args,  # otherwise usage would lack the preceding words
                prog=prog,
                description=inspect.cleandoc(command.__doc__ or ""),
                default=defaults,
                config=(tyro.conf.OmitArgPrefixes,),
            )
    except SystemExit as end:
        page, write = (err, tell) if end.code else (out, say)
        page.seek(0)
        write(*_laid_out(page.read(), terminal_width()))  # tyro repeats unknown words unescaped
        if hidden:
            say(f"{prog} {_HELP_ALL} shows {len(hidden)} more options.")
        raise
    check_targets(parsed)
    return parsed


@contextmanager
def _hiding(hides: bool) -> Iterator[set[str] | None]:
    """Leave rare fields, of a command or of the dataclasses in it, out of the help; yield their names."""
    global _hidden
    _hidden = set() if hides else None
    try:
        yield _hidden
    finally:
        _hidden = None


def _laid_out(page: str, width: int) -> list[str]:
    """Fit tyro's help, which wraps only its boxes, to the width; indented lines (examples) stay."""
    lines: list[str] = []
    for line in page.splitlines():
        lines += [line] if line.startswith(" ") else textwrap.wrap(line, width, break_on_hyphens=False) or [""]
    lines = [line.rstrip() for line in lines if line.strip(" │|") or not line]  # an empty hint may leave an empty row
    return [line for line, before in zip(lines, ["", *lines], strict=False) if line or before]


@FLAG_TYPES.struct_rule
def _with_hints(info: StructTypeInfo) -> StructConstructorSpec | None:
    """tyro's dataclass rule, with each help text in one paragraph and a hint if the default is a value."""
    if _HINTED in info.markers:
        return None
    spec = ConstructorRegistry.get_struct_spec(dataclasses.replace(info, markers=(*info.markers, _HINTED)))
    if not isinstance(spec, StructConstructorSpec):
        return None
    hints = {} if _hidden is None else get_type_hints(info.type, include_extras=True)
    fields = []
    for field in spec.fields:
        hint = "(required)" if field.default is MISSING_NONPROP else "" if field.default in (None, "", ()) else None
        kind: Any = field.type if hint is None else Annotated[field.type, tyro.conf.arg(help_behavior_hint=hint)]
        if _hidden is not None and RARE in get_args(hints.get(field.name)):
            kind = Annotated[kind, tyro.conf.Suppress]
            inner: Any = get_args(hints[field.name])[0]
            is_group = dataclasses.is_dataclass(inner)
            _hidden.update(one.name for one in dataclasses.fields(inner)) if is_group else _hidden.add(field.name)
        text = field.helptext() if callable(field.helptext) else field.helptext
        fields.append(dataclasses.replace(field, type=kind, helptext=" ".join((text or "").split())))
    return dataclasses.replace(spec, fields=tuple(fields))


def _finite_number(word: str) -> float:
    number = float(word)
    if not math.isfinite(number):
        raise ValueError(f"{word} is not a finite number")
    return number


def _whole_number(word: str) -> int:
    number = int(word)
    if not -(2**63) <= number < 2**63:
        raise ValueError(f"{word} is not a whole number of 64 bits")
    return number


def _line_of_text(word: str) -> str:
    """Read a word that may be written into a line-based file (YAML, JSON, TOML) in UTF-8."""
    if any(unicodedata.category(character) in _UNWRITABLE for character in word):
        raise ValueError(f"{printable(word)!r} is not one line of text: it has a line end or another control character")
    return word


def _path(word: str) -> Path:
    """Read a path. tyro's own error would omit the reason if several paths are allowed."""
    if not word:  # Path("") would be the current folder
        raise ConfigError("One of the paths is empty (an unset shell variable?): write the current folder as .")
    if "\0" in word:
        raise ConfigError(f"A path cannot contain a zero byte: {word}")
    return Path(word)


_VALUE_OF: Mapping[Any, Callable[[str], Any]] = {
    int: _whole_number,
    float: _finite_number,
    str: _line_of_text,
    Path: _path,
}
"""Type of an option or of one of its values -> parser of a word of the command line, which raises ValueError."""


@FLAG_TYPES.primitive_rule
def _value(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """`--noise FLOAT`; with auto for None, `--workers INT`, `--codec {auto,h264,av1}` and `--cube-mass LOW HIGH`.

    `--language [STR ...]` without a value differs from omitting the flag (None).
    """
    optional = _kind_beside_none(info.type)
    kind = info.type if optional is None else optional
    choices = ("auto", *get_args(kind)) if optional is not None and get_origin(kind) is Literal else None
    nargs: Any = 1
    part: Any = str if choices else kind
    if choices:
        metavar = f"{{{','.join(choices)}}}"
    elif optional in (tuple[int, int], tuple[float, float], tuple[Path, Path]):
        nargs, part = (1, 2), get_args(kind)[0]
        metavar = "PATH PATH" if part is Path else "LOW HIGH"
    elif optional == tuple[str, ...]:
        nargs, part, metavar = "*", str, "[STR ...]"
    elif kind in _VALUE_OF:
        metavar = kind.__name__.upper()
    else:
        return None

    def from_words(words: list[str]) -> Any:
        if optional is not None and nargs != "*" and words == ["auto"]:
            return None
        if nargs == (1, 2) and len(words) != 2:
            raise ValueError(f"two {'paths' if part is Path else 'numbers'} are needed, {metavar}, or auto")
        values = tuple(_VALUE_OF[part](word) for word in words)
        return values[0] if nargs == 1 else values

    def is_instance(value: Any) -> bool:
        if value is None:
            return optional is not None
        return value in choices if choices else isinstance(value, part if nargs == 1 else tuple)

    def to_words(value: Any) -> list[str]:
        if value is None:
            return [] if nargs == "*" else ["auto"]
        return [str(item) for item in ((value,) if nargs == 1 else value)]

    return PrimitiveConstructorSpec(nargs, metavar, from_words, is_instance, to_words, choices=choices)


def _kind_beside_none(kind: Any) -> Any:
    """`X` of `X | None`; None for every other type."""
    kinds = [part for part in get_args(kind) if part is not NoneType]
    return kinds[0] if NoneType in get_args(kind) and len(kinds) == 1 else None


Allow = Annotated[tuple[str, ...], UseAppendAction, arg(metavar="MODULE", help_behavior_hint="(may be given again)")]
"""One module or package per flag, because paths may follow."""


def allowed_modules(names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of --allow; ConfigError if one is not a valid module name."""
    for name in names:
        if not is_module_name(name):
            parts = split_name(name)
            advice = f" Did you mean {parts[0]!r}?" if parts else ""
            raise ConfigError(f"--allow names a module or package, for example my_tasks, found {name!r}.{advice}")
    return names
