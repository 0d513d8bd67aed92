"""A run or a dataset on one page: HTML that holds all it shows, reads without scripts and asks no network."""
