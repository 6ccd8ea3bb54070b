"""``python -m dyngs``, and the ``dyngs`` command."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


def main() -> int:
    """Run the command line and return the exit code; Ctrl-C ends it in silence while modules are being imported."""
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from dyngs.cli import main as run

    signal.signal(signal.SIGINT, _interrupt if before is signal.default_int_handler else before)
    return run()


def _interrupt(_: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, but end at once while a module is being imported: some swallow it, or print it."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            os.write(2, b"\ndyngs: interrupted\n")
            os._exit(130)
        frame = frame.f_back
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
