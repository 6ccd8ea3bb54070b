"""What a forward and a backward pass of the rasterizer cost as the scene and the image grow: time
and peak memory.

Each size in a process of its own, by random points as ``benchmarks/rasterize.py`` has them (scales up
to 0.02):

    python benchmarks/growth.py [--threads N] [--repeats N]
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
from dataclasses import replace

SIZES = (
    *((125_000, side) for side in (400, 800, 1600, 3840)),
    *((count, 800) for count in (500_000, 1_000_000, 3_000_000)),
    (1_000_000, 3840),
)
"""Gaussians, and the side of the square image in pixels."""


def measure(count: int, side: int, threads: int, repeats: int) -> str:
    """Return a line of the table."""
    from rasterize import bench_rasterize, random_workload

    load = random_workload(count)
    focal = 480 * side / 648
    intrinsics = load.cameras.intrinsics.new_tensor(
        [[[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]]]
    )
    cameras = replace(load.cameras, intrinsics=intrinsics, width=side, height=side)
    report = bench_rasterize(replace(load, cameras=cameras), [threads], repeats)
    times = report["runs"][0]["milliseconds"]
    del times["sgemm"]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    stages = " | ".join(f"{times[name]:.0f}" for name in times)
    return f"| {count:,} | {side} | {report['pairs'] / 1e6:.0f} | {stages} | {sum(times.values()):.0f} | {peak:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--one", type=int, nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(measure(*arguments.one, arguments.threads, arguments.repeats))
        return
    stages = "project | bin + sort | blend | blend backward | project backward | all"
    print(f"| Gaussians | side, px | M pairs | {stages}, ms | peak, GB |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for count, side in SIZES:
        options = ["--threads", str(arguments.threads), "--repeats", str(arguments.repeats)]
        subprocess.run(
            [sys.executable, __file__, "--one", str(count), str(side), *options], check=True
        )


if __name__ == "__main__":
    main()
