"""Packages that LeRobot's commands find in tests: stand-ins for hardware, and demorec's own plug-ins."""
