"""LeRobot's language columns: an episode's statements in the form of its tables, and their digests.

`language_persistent` repeats every statement of the episode in each row, with its start time; `language_events` has the
statements of one moment in that moment's row. LeRobot's own types are in `lerobot/datasets/language.py`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from demorec.core.errors import ExportError, describe_error

PERSISTENT, EVENTS = "language_persistent", "language_events"
COLUMNS = (PERSISTENT, EVENTS)

_EVENT_FIELDS = (
    pa.field("role", pa.string()),
    pa.field("content", pa.string()),
    pa.field("style", pa.string()),
    pa.field("camera", pa.string()),
    pa.field("tool_calls", pa.list_(pa.json_())),
)
_EVENT = pa.struct(_EVENT_FIELDS)
_STATE = pa.struct([*_EVENT_FIELDS[:3], pa.field("timestamp", pa.float32()), *_EVENT_FIELDS[3:]])
TYPES: dict[str, pa.DataType] = {PERSISTENT: pa.list_(_STATE), EVENTS: pa.list_(_EVENT)}
"""Column -> its type, as HF datasets reads LeRobot's own."""
REPEATING = tuple(f"{name}.list.element.{item}" for name in COLUMNS for item in ("role", "content", "style", "camera"))
REPEATING += (f"{PERSISTENT}.list.element.timestamp",)
"""Parquet names of the parts with repeating values."""

_AT_ONCE = 16
"""Number of rows of an episode built in one step."""


class Statement(NamedTuple):
    """One sentence, valid from a row of the episode, counted from 0, until the next one of its kind."""

    row: int
    kind: str
    text: str


@dataclass(frozen=True, kw_only=True)
class EpisodeLanguage:
    """Language columns of one episode; entries in the columns' form, tool calls as JSON.

    Attributes:
        persistent: Entries in every row; read from the first row.
        events: Row -> entries of that row only, for rows that have any.
    """

    persistent: Sequence[dict[str, Any]] = ()
    events: Mapping[int, Sequence[dict[str, Any]]] = field(default_factory=dict)


def episode_language(statements: Sequence[Statement], *, fps: int) -> EpisodeLanguage:
    """Convert statements to LeRobot's form; times are bit-exact with the `timestamp` column."""
    persistent = [
        {
            "role": "user" if statement.kind == "task_aug" else "assistant",
            "content": statement.text,
            "style": statement.kind,
            "timestamp": float(np.float32(statement.row / fps)),
            "camera": None,
            "tool_calls": None,
        }
        for statement in statements
    ]
    return EpisodeLanguage(persistent=persistent)


def language_feature(name: str) -> dict[str, Any]:
    """Schema metadata of a language column, from which HF datasets takes its types."""
    text = {"dtype": "string", "_type": "Value"}
    row: dict[str, Any] = {"role": text, "content": text, "style": text}
    if name == PERSISTENT:
        row["timestamp"] = {"dtype": "float32", "_type": "Value"}
    calls = {"feature": {"_type": "Json"}, "_type": "List"}
    return {"feature": {**row, "camera": text, "tool_calls": calls}, "_type": "List"}


def language_arrays(language: EpisodeLanguage, frames: int) -> dict[str, pa.Array]:
    """Column -> array with `frames` rows."""
    counts = np.zeros(frames + 1, dtype=np.int32)
    for row, entries in language.events.items():
        counts[row + 1] = len(entries)
    said = [entry for _, entries in sorted(language.events.items()) for entry in entries]
    state = _structs(language.persistent, _STATE)
    # In two steps, because each costs by its number of parts; `take` costs three times as much.
    several = pa.concat_arrays([state] * _AT_ONCE)
    often = pa.concat_arrays([state[:0], *[several] * (frames // _AT_ONCE), *[state] * (frames % _AT_ONCE)])
    steps = pa.array(np.arange(frames + 1, dtype=np.int32) * np.int32(len(state)))
    return {
        PERSISTENT: pa.ListArray.from_arrays(steps, often),
        EVENTS: pa.ListArray.from_arrays(pa.array(np.cumsum(counts, dtype=np.int32)), _structs(said, _EVENT)),
    }


def _structs(found: Sequence[dict[str, Any]], kind: pa.StructType) -> pa.StructArray:
    arrays = []
    for part in kind:
        values = [row[part.name] for row in found]
        if part.name != "tool_calls":
            arrays.append(pa.array(values, part.type))
        elif not any(values):
            arrays.append(pa.nulls(len(found), part.type))
        else:  # PyArrow does not build JSON from Python lists
            arrays.append(pa.array(values, pa.list_(pa.string())).cast(part.type))
    return pa.StructArray.from_arrays(arrays, fields=list(kind))


def is_language(kind: pa.DataType) -> bool:
    """Whether a column of this type can hold statements; for empty columns, LeRobot's tools write lists of nulls."""
    listed = pa.types.is_list(kind) or pa.types.is_large_list(kind)
    return bool(listed) and bool(pa.types.is_struct(kind.value_type) or pa.types.is_null(kind.value_type))


def column_digests(column: pa.Array) -> NDArray[np.str_]:
    """(T, 1) SHA-256 (hex) of the content of each row of a language column, from any writer. Raises ValueError if it is
    not a list of structures.
    """
    if not is_language(column.type):
        raise ValueError(f"a language column of type {column.type}")
    found: list[str] = []
    before: pa.Array | None = None
    for index in range(len(column)):
        rows = column[index].values
        if before is None or rows is None or not rows.equals(before):
            found.append(_digest([] if rows is None else rows.to_pylist()))
        else:  # the persistent entries are the same in each row
            found.append(found[-1])
        before = rows
    return np.array(found, dtype="<U64").reshape(-1, 1)


def _digest(rows: Sequence[Mapping[str, Any]]) -> str:
    """Digest of the entries present; an empty list of tool calls equals none, and JSON counts by its value."""
    known = [{name: value for name, value in row.items() if value is not None and value != []} for row in rows]
    for row in known:
        if "tool_calls" in row:
            row["tool_calls"] = [_parsed(call) for call in row["tool_calls"]]
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()


def _parsed(call: Any) -> Any:
    try:
        return json.loads(call)
    except (TypeError, ValueError, RecursionError):
        return call


def spoken_of(batches: Iterable[pa.RecordBatch], path: Path) -> EpisodeLanguage:
    """Language of one episode, from any writer, from its rows of both columns; `path` is the dataset's folder. Raises
    ExportError if they cannot be read.
    """
    said: list[dict[str, Any]] = []
    events: dict[int, list[dict[str, Any]]] = {}
    number = 0
    try:
        for batch in batches:
            persistent, of_rows = (batch.column(name) for name in COLUMNS)
            if not is_language(persistent.type) or not is_language(of_rows.type):
                raise ValueError("language columns with another type")
            for row in range(len(batch)):
                if not number:
                    said = persistent[row].as_py() or []
                if found := of_rows[row].as_py():
                    events[number] = found
                number += 1
    except (ValueError, pa.ArrowException) as error:
        raise ExportError(f"The language of the dataset cannot be read ({describe_error(error)}): {path}") from error
    return EpisodeLanguage(persistent=said, events=events)
