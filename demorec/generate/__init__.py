"""Generation: from a config to a folder of verified recordings, independent of workers, order and crashes.

The entry point is `demorec.generate.run.generate`; `demorec.runs.run_file.load_run_file` reads a run's description.
"""
