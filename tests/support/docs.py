"""Python examples of README.md and docs/, to be run by tests."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[2]


def run_examples(document: str, word: str, paths: Mapping[str, Path]) -> int:
    """Run every Python example of a document that has the word in it; returns how many there were.

    `paths` replaces what an example reads: each quoted text by the path of a file that is there.
    """
    examples: list[str] = re.findall(r"```python\n(.*?)```", (ROOT / document).read_text(), re.DOTALL)
    chosen = [text for text in examples if word in text]
    for text in chosen:
        for quoted, path in paths.items():
            assert f'"{quoted}"' in text
            text = text.replace(f'"{quoted}"', repr(str(path)))
        exec(compile(text, document, "exec"), {})
    return len(chosen)
