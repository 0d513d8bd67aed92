"""From a config to a folder of verified recordings: the same dataset whatever the workers, the order or the crashes.

`demorec.generate.run.generate` is the way in; `demorec.runs.run_file.load_run_file` reads what a run is.
"""
