"""Run the Python examples of README.md and docs/."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[2]


def run_examples(document: str, word: str, paths: Mapping[str, Path]) -> int:
    """Run every Python example of a document that contains the word; returns the number of examples.

    `paths` replaces the inputs of an example: each quoted text by the path of an existing file.
    """
    examples: list[str] = re.findall(r"```python\n(.*?)```", (ROOT / document).read_text(), re.DOTALL)
    chosen = [text for text in examples if word in text]
    for text in chosen:
        for quoted, path in paths.items():
            assert f'"{quoted}"' in text
            text = text.replace(f'"{quoted}"', repr(str(path)))
        exec(compile(text, document, "exec"), {})
    return len(chosen)
