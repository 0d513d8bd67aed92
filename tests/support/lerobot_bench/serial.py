"""Stand-in for pyserial, of which LeRobot's bus needs only the error."""


class SerialException(Exception):
    pass
