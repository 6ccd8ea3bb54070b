"""``dyngs demo``: train, evaluate, render and export a built-in moving scene."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyngs.cli.arguments import output_path, threads
from dyngs.errors import DyngsError, as_word


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``demo`` to the commands."""
    parser = commands.add_parser(
        "demo",
        help="train, evaluate and render a built-in moving scene",
        description="Ray trace a small moving scene, train on it, evaluate, render images and a video, write a .ply.",
    )
    parser.add_argument(
        "--out", type=output_path, default=Path("dyngs-demo"), metavar="DIR", help="output folder (default dyngs-demo)"
    )
    parser.add_argument("--steps", type=int, default=3000, metavar="N", help="training steps (default 3000)")
    parser.add_argument("--threads", type=threads, default=0, metavar="N", help="number of threads, 0 = all cores")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the demo and print the results and the paths of the files."""
    if arguments.steps < 1 or arguments.threads < 0:
        raise DyngsError("--steps must be at least 1, --threads at least 0")
    from rich.console import Console

    from dyngs.demo import DemoOptions, result_table, run_demo

    result = run_demo(arguments.out, DemoOptions(steps=arguments.steps, threads=arguments.threads))
    Console().print(result_table(result))
    print(f"truth, render, error  {result.sheet}")
    print(f"test views            {result.images}")
    print(f"orbit video           {result.video}")
    print(f"for other viewers     {result.ply}")
    print(f"run folder            {result.run_dir}")
    print(f"to look around        dyngs view {as_word(result.run_dir)}    (pip install 'dyngs[view]')")
    print(f"one page to share     dyngs export {as_word(result.run_dir)} --out scene.html")
    return 0
