"""demorec: robot demonstrations people can trust."""
