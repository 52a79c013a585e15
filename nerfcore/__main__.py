"""`python -m nerfcore serve` is the engine; every other verb is the command line's."""

import gc
import os
import signal
import sys

CANCELLED = 130  # exit code


def main() -> None:
    if sys.argv[1:] == ["serve"]:  # with options, the command line says what they mean
        from .engine.server import main as serve

        sys.exit(serve())
    # Ctrl-C while modules load, before anything has begun; a verb then asks for it in its own way.
    signal.signal(signal.SIGINT, lambda *_: os._exit(CANCELLED))
    from .cli import main as command_line

    code = command_line()
    if code == CANCELLED:
        # Whoever cancels does not wait for native libraries to be taken down: what is on disk is whole.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    gc.freeze()  # at its end Python looks for garbage in all that libraries made: up to a second
    sys.exit(code)


if __name__ == "__main__":
    main()
