"""What the robot does: one task per file, rows in `demorec.core.tables.TASKS`."""
