"""Run LeRobot's commands one after the other in one process, each by its `main`, as its program does.

Argument: a JSON list of {"command": "lerobot_record", "args": [...], "env": {...}}.
"""

from __future__ import annotations

import importlib
import json
import os
import sys

if __name__ == "__main__":
    for step in json.loads(sys.argv[1]):
        os.environ |= step["env"]
        sys.argv = [step["command"], *step["args"]]
        importlib.import_module(f"lerobot.scripts.{step['command']}").main()
        print(f"done: {step['command']}", flush=True)
