"""Foundations of all other packages: errors, numbers, tables, and protection of the user's files and processes."""
