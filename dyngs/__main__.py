"""``python -m dyngs``, and the ``dyngs`` command."""

from __future__ import annotations

import signal
import sys


def main() -> int:
    """Run the command line and return the exit code; Ctrl-C ends it in silence while modules are being imported."""
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from dyngs.cli import main as run

    signal.signal(signal.SIGINT, before)
    return run()


if __name__ == "__main__":
    sys.exit(main())
