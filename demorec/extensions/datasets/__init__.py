"""Edit LeRobot datasets from any writer: an edit is planned first, then written in one pass."""
