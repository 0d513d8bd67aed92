"""The doctor: checks of a dataset from any source before training on it."""
