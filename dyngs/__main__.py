"""``python -m dyngs``: the same as the ``dyngs`` command."""

from __future__ import annotations

import sys

from dyngs.cli import main

if __name__ == "__main__":
    sys.exit(main())
