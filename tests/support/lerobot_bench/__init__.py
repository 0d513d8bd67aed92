"""What LeRobot's commands find installed in tests: stand-ins for hardware, and demorec's own plug-ins."""
