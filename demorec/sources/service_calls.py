"""Calls of ROS 2 services, from the events that service introspection publishes and rosbag2 records.

A call has up to four events: its request sent and received, its response sent and received, as the client, the server
or both are watched. Their messages hold what was said only where introspection is set to "contents".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from demorec.mcap.cdr import Values
from demorec.sources.fields import FieldError, follow, parse_path, stamp_of

_IS_REQUEST = {0: True, 1: True, 2: False, 3: False}
"""`event_type` of service_msgs/ServiceEventInfo: REQUEST_SENT, REQUEST_RECEIVED, RESPONSE_SENT, RESPONSE_RECEIVED."""


@dataclass(kw_only=True)
class ServiceCall:
    """A call.

    Attributes:
        time_ns: Of the first event of its request, as the mapping's clock takes it.
        request: What was asked for; None where the bag does not hold it.
        is_refused: Whether the service refused it (`success` of its response).
    """

    time_ns: int
    request: Values | None = None
    is_refused: bool = False

    def value(self, field: str) -> Any:
        """A field of the request; FieldError when it is not there."""
        if self.request is None:
            raise FieldError("the bag holds no requests: set service introspection to 'contents' when recording")
        return follow(self.request, parse_path(field))


class CallReader:
    """Gathers the events of one service, in the order of the bag.

    Args:
        by_header: Whether times are those of the events, or when they were recorded.
    """

    def __init__(self, *, by_header: bool) -> None:
        self._by_header = by_header
        self._found: dict[tuple[bytes, int], ServiceCall] = {}

    def add(self, values: Values, log_ns: int) -> None:
        """Take an event; FieldError for another message."""
        try:
            self._take(values, log_ns)
        except FieldError:
            raise
        except (TypeError, ValueError, OverflowError) as error:  # a field of that name, but of another type
            raise FieldError("it holds no events of a service") from error

    def _take(self, values: Values, log_ns: int) -> None:
        info = values.get("info")
        if not isinstance(info, Mapping) or not {"event_type", "sequence_number"} <= info.keys():
            raise FieldError("it holds no events of a service")
        is_request = _IS_REQUEST.get(info["event_type"])
        if is_request is None:
            raise FieldError(f"an event of a service is of the unknown type {info['event_type']}")
        key = bytes(memoryview(info.get("client_gid", b""))), int(info["sequence_number"])
        if is_request:
            stamp = stamp_of({"stamp": info.get("stamp")}) if self._by_header else None
            call = self._found.setdefault(key, ServiceCall(time_ns=log_ns if stamp is None else stamp))
            call.request = call.request or _first(values.get("request"))
        elif key in self._found:
            response = _first(values.get("response")) or {}
            self._found[key].is_refused |= response.get("success") in (False, 0)

    def calls(self) -> list[ServiceCall]:
        """Those that the service did not refuse."""
        return [call for call in self._found.values() if not call.is_refused]


def _first(items: Any) -> Values | None:
    """Of a sequence of at most one."""
    return items[0] if isinstance(items, list) and items and isinstance(items[0], dict) else None
