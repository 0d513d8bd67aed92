"""CPU time of `demorec check`, and of another version of the program.

    python benchmarks/check.py --episodes 5
    git worktree add /tmp/before HEAD~1 && python benchmarks/check.py --against /tmp/before

The script makes two runs: without cameras, and with two, depth and labels. A process for each version alternately
checks the same recordings, run folder and dataset, so that both have the same load. The first recording of a process is
listed separately, because libraries are loaded for it. LeRobot is not started.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

CASES = {
    "no cameras": ("--cameras", "none"),
    "two cameras, depth, labels": ("--depth", "--segmentation"),
}


def serve() -> None:
    """Check every path on standard input and print the CPU time."""
    from demorec.check.report import CheckOptions, check_subject, find_subjects

    for line in sys.stdin:
        subject = find_subjects([Path(line.strip())])[0]
        start = time.process_time()
        report = check_subject(subject, CheckOptions())
        print(time.process_time() - start, report.verdict, flush=True)


class Checker:
    """A process that runs the checks of one version.

    Args:
        folder: Folder that contains demorec/.
    """

    def __init__(self, folder: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--serve"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(folder)},
        )

    def seconds(self, path: Path) -> float:
        """CPU time of checking a recording, a run's folder or a dataset."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(path, file=self._process.stdin, flush=True)
        seconds, verdict = self._process.stdout.readline().split()
        if verdict != "good":
            raise SystemExit(f"{path} did not pass: {verdict}")
        return float(seconds)

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def main() -> None:
    """Make runs, check them, print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--against", type=Path, help="a folder with another version of demorec/")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve()
        return
    versions = {"now": Path(__file__).resolve().parents[1]}
    if options.against is not None:
        versions = {"before": options.against.resolve(), **versions}
    print(f"{'CPU ms':<42}" + "".join(f"{name:>10}" for name in versions))
    with tempfile.TemporaryDirectory() as folder:
        for case, flags in CASES.items():
            run = Path(folder) / case.replace(", ", "_").replace(" ", "_")
            command = [str(Path(sys.executable).with_name("generate-dataset")), "--seed", "3", "--out", str(run)]
            command += ["--num-episodes", str(options.episodes + 1), "--workers", "1", *flags]
            subprocess.run(command, check=True, capture_output=True)
            checkers = {name: Checker(place) for name, place in versions.items()}
            first, *others = sorted((run / "episodes").glob("*.mcap"))
            subjects = {"first recording": [first], "recording": others, "run's folder": [run]}
            subjects["dataset"] = [run / "dataset"]
            for what, paths in subjects.items():
                cpu: dict[str, float] = defaultdict(float)
                for path in paths:
                    for name, checker in checkers.items():
                        cpu[name] += checker.seconds(path) / len(paths)
                figures = "".join(f"{1e3 * cpu[name]:10.0f}" for name in versions)
                print(f"{f'{case}: {what}':<42}{figures}", flush=True)
            for checker in checkers.values():
                checker.close()


if __name__ == "__main__":
    main()
