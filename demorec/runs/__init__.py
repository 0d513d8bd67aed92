"""What a run is on disk: its record run.json, its lock, its recordings."""
