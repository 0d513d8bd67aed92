"""Where the programs `demorec` and `generate-dataset` begin, and `python -m demorec`.

Nothing is imported before Ctrl-C is an exit code: loading the command line takes a third of a second, in which people
have time to think better of it.
"""


def main() -> None:
    """`demorec`."""
    _start("main")


def generate_dataset() -> None:
    """`generate-dataset`."""
    _start("generate_dataset_main")


def _start(program: str) -> None:
    try:
        from demorec import cli

        getattr(cli, program)()
    except KeyboardInterrupt:
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
