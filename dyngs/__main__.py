"""``python -m dyngs``, and the ``dyngs`` command."""

from __future__ import annotations

try:
    import os
    import signal
    import sys
    from types import FrameType
except KeyboardInterrupt:  # Ctrl-C before there is a handler for it
    raise SystemExit(130) from None


def main() -> int:
    """Run the command line and return the exit code."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    try:
        from dyngs.cli import main as run
    except KeyboardInterrupt:
        return 130
    return run()


def _interrupt(_: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, or exit at once during imports, where some modules suppress it."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            os.write(2, b"\ndyngs: interrupted\n")
            os._exit(130)
        frame = frame.f_back
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
