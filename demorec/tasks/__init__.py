"""Robot tasks: their common parts and the first one; rows in `demorec.core.tables.TASKS`."""
