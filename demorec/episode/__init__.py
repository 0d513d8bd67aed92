"""Episodes as plain data: scenes, frames, features, outcomes, and how much they vary."""
