"""One file per robot: a `RobotSpec` each."""
