"""LeRobot v3.0: export of recordings, and reading of datasets from any writer."""
