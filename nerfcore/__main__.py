"""`python -m nerfcore serve` is the engine; every other verb is the command line's."""

import os
import signal
import sys


def main() -> None:
    if sys.argv[1:2] == ["serve"]:
        from .engine.server import main as serve

        sys.exit(serve())
    # Ctrl-C while modules load, before anything has begun; a verb then asks for it in its own way.
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    from .cli import main as command_line

    sys.exit(command_line())


if __name__ == "__main__":
    main()
