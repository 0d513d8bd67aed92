"""Episodes as plain data: scenes, frames, features, outcomes, and their variation."""
