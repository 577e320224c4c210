"""The command ``cellquant``, also as ``python -m cellquant``."""

import os
import signal
from types import FrameType


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(130)


def main() -> None:
    """Load the program and run it; an interruption while it is loaded ends it in silence."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    from cellquant.cli import main as run

    run()


if __name__ == "__main__":
    main()
