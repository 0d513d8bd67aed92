"""Scores for the episodes of a dataset, from 0 to 1, with reasons in words and frames."""
