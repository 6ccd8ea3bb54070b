"""Held-out PSNR of a capture in other units of length, and far from its origin.

    python benchmarks/units.py FOLDER CAPTURE PRESET... [--at SCALE:OFFSET ...] [key=value ...]

CAPTURE has transforms files. OFFSET is in extents of the cameras. Every row should show the same
PSNR, within what rounding decides in a training (about 0.3 dB).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from scaled_captures import scaled_capture

import dyngs
from dyngs.api.train import train
from dyngs.evaluate.report import evaluate_run

PLACES = ("1:0", "1e-4:0", "0.05:0", "1e3:0", "1:1e6")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("words", nargs="+", metavar="PRESET or key=value")
    parser.add_argument("--at", nargs="+", default=PLACES, metavar="SCALE:OFFSET")
    given = parser.parse_intermixed_args()
    overrides = [word for word in given.words if "=" in word]
    print(f"| preset | {' | '.join(given.at)} |\n|---|{'---|' * len(given.at)}")
    for preset in (word for word in given.words if "=" not in word):
        cells = []
        for place in given.at:
            scale, offset = (float(number) for number in place.split(":"))
            capture = given.folder / f"capture_{place.replace(':', '_')}"
            if not capture.exists():
                extent = 5.0  # of NeRF-synthetic scenes
                scaled_capture(given.capture, capture, scale, (offset * extent, 0.0, 0.0))
            run = given.folder / f"{preset}_{capture.name}"
            config = dyngs.load_config(
                preset, [f"data.root={capture}", f"run.dir={run}", *overrides]
            )
            train(config)
            cells.append(f"{evaluate_run(run).psnr:.2f}")
        print(f"| {preset} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
