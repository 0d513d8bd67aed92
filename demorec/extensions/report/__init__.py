"""A run or a dataset on one self-contained HTML page that needs neither scripts nor network."""
