"""In place of pyserial, of which LeRobot's bus knows the error alone."""


class SerialException(Exception):
    pass
