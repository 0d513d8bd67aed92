"""LeRobot v3.0: recordings to datasets, and datasets read, whoever wrote them."""
