"""What several tests share: recordings made by hand, runs and datasets, readers, commands."""
