"""`python -m nerfcore serve` is the engine; every other verb is the command line's."""

import sys


def main() -> None:
    if sys.argv[1:2] == ["serve"]:
        from .engine.server import main as serve

        sys.exit(serve())
    from .cli import main as command_line

    sys.exit(command_line())


if __name__ == "__main__":
    main()
