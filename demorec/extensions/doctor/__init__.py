"""The doctor: what to know about a dataset before training on it, whoever recorded it."""
