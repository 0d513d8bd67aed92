"""Entry points of the programs `demorec` and `generate-dataset`, and of `python -m demorec`.

Commands that read files continue in a limited child process, forked before any heavy import. Ctrl-C while the command
line loads (about 0.3 s) gives an exit code.
"""

from __future__ import annotations

import sys


def main() -> None:
    """Run `demorec`."""
    _start("main", is_limited=True)


def generate_dataset() -> None:
    """Run `generate-dataset`."""
    _start("generate_dataset_main", is_limited=False)


def _start(program: str, *, is_limited: bool) -> None:
    try:
        from demorec.core.streams import open_closed_streams

        open_closed_streams()
        if is_limited:
            from demorec.core.limited import continue_in_child

            continue_in_child(sys.argv[1:])
        from demorec import cli

        getattr(cli, program)()
    except KeyboardInterrupt:
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
