"""Robot tasks: families of tasks, one file each, rows in `demorec.core.tables.TASKS`."""
