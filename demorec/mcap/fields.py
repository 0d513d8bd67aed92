"""Any message taken apart into its fields by the definition of its type, so that what differs can be named.

The batch layouts of `streams` are for speed and know only what a recording should hold; here every byte has a name.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from demorec.mcap.cdr import HEADER, CdrReader
from demorec.mcap.messages import PROTOBUF_VIDEO, protobuf_fields
from demorec.mcap.ros2 import DEFINITIONS, Types, types_of

Value = bool | int | float | str | bytes


def message_fields(schema: str, data: bytes) -> dict[str, Value]:
    """Name of each field, as in `pose.position.x` or `position[3]`, -> its value, in order.

    A sequence also has its length, as `position.length`; octets (a coded picture) are one value.

    Args:
        schema: Type of the message, one that recordings use.
        data: The message.

    Raises:
        ValueError: The message is not of this type, or the type is unknown.
    """
    if schema == PROTOBUF_VIDEO:
        return dict(protobuf_fields(data))
    if schema not in DEFINITIONS:
        raise ValueError(f"no recording has messages of the type {schema!r}")
    if data[:4] != HEADER:
        raise ValueError("a message of another encapsulation")
    reader = CdrReader(data, text=lambda raw: raw.decode(errors="backslashreplace").removesuffix("\0"))
    found = dict(_leaves(types_of(schema), "", "", reader.values(schema)))
    if reader.num_left:
        raise ValueError(f"a message with {reader.num_left} bytes too many")
    return found


def _leaves(types: Types, kind: str, prefix: str, values: Any) -> Iterator[tuple[str, Value]]:
    """Path and value of every field of a struct."""
    for field, value in zip(types[kind], values, strict=True):
        path = prefix + field.name
        if not field.is_array or isinstance(value, bytes):
            items = [(path, value)]
        else:
            if field.length is None:
                yield f"{path}.length", len(value)
            numbers = value.tolist() if isinstance(value, np.ndarray) else value
            items = [(f"{path}[{index}]", item) for index, item in enumerate(numbers)]
        for place, item in items:
            if field.kind in types:
                yield from _leaves(types, field.kind, f"{place}.", item)
            else:
                yield place, item
