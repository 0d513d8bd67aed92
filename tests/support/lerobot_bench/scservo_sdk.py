"""Stand-in for Feetech's library: six servos that reach their goals instantly, and log them.

STUB_CALIBRATION names a file in LeRobot's form, which their registers hold; STUB_LOG the file of goals, one line each.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

COMM_SUCCESS = 0
MAX_ID = 252
MODEL = 777
_LIMITS, _HOMING, _GOAL, _PRESENT = (9, 11), 31, 42, 56

registers: dict[int, bytearray] = {}


def SCS_LOBYTE(value: int) -> int:
    return value & 0xFF


def SCS_HIBYTE(value: int) -> int:
    return value >> 8 & 0xFF


def _put(servo: int, address: int, data: bytes) -> None:
    registers[servo][address : address + len(data)] = data
    if address == _GOAL:
        registers[servo][_PRESENT : _PRESENT + 2] = data
        if log := os.environ.get("STUB_LOG"):
            with Path(log).open("a") as file:
                file.write(f"{servo} {int.from_bytes(data, 'little')}\n")


def _get(servo: int, address: int, length: int) -> int:
    return int.from_bytes(registers[servo][address : address + length], "little")


class PortHandler:
    tx_time_per_byte = 0.01

    def __init__(self, port: str) -> None:
        self.port_name, self.is_open, self.is_using = port, False, False
        for motor in json.loads(Path(os.environ["STUB_CALIBRATION"]).read_text()).values():
            servo = registers[motor["id"]] = bytearray(256)
            middle = (motor["range_min"] + motor["range_max"]) // 2
            places = {_LIMITS[0]: motor["range_min"], _LIMITS[1]: motor["range_max"], _PRESENT: middle}
            for address, count in {**places, _HOMING: motor["homing_offset"]}.items():
                servo[address : address + 2] = count.to_bytes(2, "little")

    def openPort(self) -> bool:
        self.is_open = True
        return True

    def closePort(self) -> None:
        self.is_open = False

    def clearPort(self) -> None:
        pass

    def setPacketTimeoutMillis(self, _: float) -> None:
        pass


class PacketHandler:
    def __init__(self, _: int) -> None:
        pass

    def ping(self, _: PortHandler, servo: int) -> tuple[int, int, int]:
        return (MODEL, COMM_SUCCESS, 0) if servo in registers else (0, -1, 0)

    def read1ByteTxRx(self, _: PortHandler, servo: int, address: int) -> tuple[int, int, int]:
        return _get(servo, address, 1), COMM_SUCCESS, 0

    def read2ByteTxRx(self, _: PortHandler, servo: int, address: int) -> tuple[int, int, int]:
        return _get(servo, address, 2), COMM_SUCCESS, 0

    def writeTxRx(self, _: PortHandler, servo: int, address: int, length: int, data: list[int]) -> tuple[int, int]:
        assert len(data) == length
        _put(servo, address, bytes(data))
        return COMM_SUCCESS, 0


class GroupSyncRead:
    def __init__(self, *_: object) -> None:
        self.start_address = self.data_length = 0

    def clearParam(self) -> None:
        pass

    def addParam(self, servo: int) -> None:
        assert servo in registers

    def txRxPacket(self) -> int:
        return COMM_SUCCESS

    def getData(self, servo: int, address: int, length: int) -> int:
        return _get(servo, address, length)


class GroupSyncWrite(GroupSyncRead):
    def clearParam(self) -> None:
        self._data: dict[int, list[int]] = {}

    def addParam(self, servo: int, data: list[int] | None = None) -> None:
        assert data is not None
        self._data[servo] = data

    def txPacket(self) -> int:
        for servo, data in self._data.items():
            _put(servo, self.start_address, bytes(data))
        return COMM_SUCCESS
