"""Messages of ROS 1 and ROS 2 as plain values, by the definitions that a bag carries.

`rosbags` parses the definitions; its own deserialisers, and those of others, are programs that are made of the
definition's text and run. A definition from a foreign file is data here: it becomes a chain of ready-made readers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import make_typesdict
from rosbags.typesys.idl import IDLParser
from rosbags.typesys.msg import MSGParser
from rosbags.typesys.peg import Parser

from demorec.mcap.cdr import Readers, Values, lenient_text, read_whole
from demorec.mcap.limits import Budget, Limits, SpentError
from demorec.mcap.ros2 import FieldType, Types

_TIME = (FieldType("sec", "int32", False, None), FieldType("nanosec", "uint32", False, None))
_BUILT_IN = {"builtin_interfaces/msg/Time": _TIME, "builtin_interfaces/msg/Duration": _TIME}
_SEPARATOR = "=" * 80 + "\n"
"""Between the definitions of types that are in one text."""


class Budgets:
    """What may be made of a bag's definitions and messages, whatever they claim: counted while it is made.

    Args:
        num_bytes: Of the bag's files.

    Attributes:
        steps: Of parsing definitions, some 7 microseconds each. The largest definition of ROS, with all that it refers
            to, takes 2,200 of them as .msg, and one of 300 fields 130,000 to 790,000 as .idl.
        values: Fields and elements, 100 to 300 bytes each in memory. A message of joints has 30, a list of 100,000
            points 400,000. Small files have a floor, 5 million, which are read in some seconds.
        numbers: Bytes of what streams keep of the messages.
    """

    def __init__(self, num_bytes: int = 0) -> None:
        floor = Limits.of_file(num_bytes).floor
        self.steps = Budget(floor // 56, 800_000, "parts of definitions")
        self.values = Budget(max(floor // 13, 12 * num_bytes), 500_000, "values")
        numbers = max(floor, 100 * num_bytes)
        self.numbers = Budget(numbers, numbers, "bytes of numbers")


def ros_decoder(
    type_name: str, schema_encoding: str, schema: bytes, *, is_cdr: bool, budgets: Budgets
) -> Callable[[bytes], Values]:
    """What makes values of the messages of a type.

    Args:
        type_name: "sensor_msgs/msg/JointState" (or as in ROS 1, without "msg").
        schema_encoding: ros2msg, ros2idl, ros1msg; "" for a type of ROS itself that comes without a definition.
        schema: The definition.
        is_cdr: Whether messages are CDR (ROS 2), otherwise as ROS 1 serialises them.
        budgets: What may be made of the bag.

    Raises:
        ValueError: The definition cannot be read; or, from the decoder, a message does not fit it, or holds too much.
    """
    parts = type_name.split("/")
    name = f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else type_name
    budgets.steps.begin()
    types = _types(name, schema_encoding, schema, budgets.steps)
    budget = budgets.values
    readers = [
        Readers(types, order=order, is_aligned=is_cdr, text=lenient_text, take=budget.take).of(name) for order in "><"
    ]

    def decode(data: bytes) -> Values:
        budget.begin()
        if not is_cdr:
            return read_whole(readers[1], memoryview(data))[0]
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            raise ValueError("its first bytes are not those of a CDR message")
        return read_whole(readers[data[1]], memoryview(data)[4:])[0]

    return decode


class _Counted(Parser):  # type: ignore[misc]
    """Counts its steps: what takes long is no matter of a text's length alone."""

    def __init__(self, text: str, steps: Budget) -> None:
        super().__init__(text)
        self._steps = steps

    def regex(self, pos: int, pattern: str, flags: int = 0) -> Any:
        self._steps.take()
        return super().regex(pos, pattern, flags)


class _CountedMsgParser(_Counted, MSGParser):  # type: ignore[misc]
    pass


class _CountedIdlParser(_Counted, IDLParser):  # type: ignore[misc]
    def _binop(self, pos: int, left: Any, op: str, right: Any) -> Any:
        found = super()._binop(pos, left, op, right)
        if getattr(getattr(found, "value", None), "op", "") in ("*", "<<"):  # numbers without end
            raise ValueError("its definition computes numbers, which is not read")
        return found


def _from_msg(text: str, name: str, steps: Budget) -> Any:
    return make_typesdict(_CountedMsgParser(f"MSG: {name}\n{text}", steps).specification())


def _types(name: str, schema_encoding: str, schema: bytes, steps: Budget) -> Types:
    key = (name, schema_encoding, schema)
    if key not in _parsed:
        found = _parsed_types(name, schema_encoding, schema, steps)
        if len(_parsed) >= _MAX_PARSED:
            _parsed.clear()
        _parsed[key] = found
    return _parsed[key]


_MAX_PARSED = 512
_parsed: dict[tuple[str, str, bytes], Types] = {}
"""(type, encoding, definition) -> its types: a bag is read twice, and the next one has the same definitions."""


def _parsed_types(name: str, schema_encoding: str, schema: bytes, steps: Budget) -> Types:
    try:
        if schema_encoding in ("ros2msg", "ros1msg"):
            parsed = _from_msg(schema.decode(), name, steps)
        elif schema_encoding == "ros2idl":
            parsed = {}
            text = schema.decode()
            parts = [part.partition("\n")[2] for part in text.split(_SEPARATOR)[1:]] if _SEPARATOR in text else []
            for part in parts or [text]:
                parsed |= make_typesdict(_CountedIdlParser(part, steps).specification())
        elif not schema_encoding:
            parsed = dict(get_typestore(Stores.ROS2_HUMBLE).fielddefs)
        else:
            raise ValueError(f"its definition is in {schema_encoding[:40]!r}")
    except RecursionError:
        raise ValueError("its definition is nested too deeply") from None
    except (ValueError, MemoryError, SpentError):
        raise
    except Exception as error:  # the parser's own errors, and what it does not foresee
        raise ValueError("its definition cannot be read") from error
    if name not in parsed:
        raise ValueError("it comes without a definition, and is no type of ROS itself")
    found = {kind: tuple(_field_type(*field) for field in fields) for kind, (_, fields) in parsed.items()}
    return found | {kind: fields for kind, fields in _BUILT_IN.items() if not found.get(kind)}


def _field_type(name: str, description: Any) -> FieldType:
    """A field as the definitions of recordings have it; ValueError for lists of lists."""
    kind, rest = description
    if kind not in (Nodetype.SEQUENCE, Nodetype.ARRAY):
        return FieldType(name, rest[0] if kind == Nodetype.BASE else rest, False, None)
    (inner, of), length = rest
    if inner not in (Nodetype.BASE, Nodetype.NAME):
        raise ValueError("it has lists of lists, which are not read")
    return FieldType(name, of[0] if inner == Nodetype.BASE else of, True, length if kind == Nodetype.ARRAY else None)
