"""Policies: reading datasets for training, pretraining, evaluation and correction."""
