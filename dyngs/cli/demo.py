"""``dyngs demo``: train, evaluate, render and export a built-in moving scene."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyngs.cli.arguments import Commands, add_command, add_threads, output_path, whole
from dyngs.cli.output import numbers_table, print_tables
from dyngs.core.errors import as_word


def add_parser(commands: Commands) -> None:
    about = "Ray trace a small moving scene, train on it, evaluate, render images and a video, write a .ply."
    parser = add_command(
        commands, "demo", run, "train, evaluate and render a built-in moving scene", about
    )
    out = "output folder (default dyngs-demo)"
    default = Path("dyngs-demo")
    parser.add_argument("--out", type=output_path, default=default, metavar="DIR", help=out)
    kind = whole("a number of steps", 1, 10**9)
    parser.add_argument(
        "--steps", type=kind, default=3000, metavar="N", help="training steps (default 3000)"
    )
    add_threads(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the demo and print the results and the paths of the files."""
    from dyngs.cli.demo_run import DemoOptions, result_table, run_demo
    from dyngs.cli.training_progress import TrainingProgress

    options = DemoOptions(steps=arguments.steps, threads=arguments.threads)
    with TrainingProgress() as progress:
        result = run_demo(arguments.out, options, [progress])
    print_tables(numbers_table(*result_table(result)))
    print(f"truth, render, error  {result.images / 'sheet.png'}")
    print(f"test views            {result.images}")
    print(f"orbit video           {result.video}")
    print(f"for other viewers     {result.ply}")
    print(f"run folder            {result.run_dir}")
    print(
        f"to look around        dyngs view {as_word(result.run_dir)}    (pip install 'dyngs[view]')"
    )
    print(f"one page to share     dyngs export {as_word(result.run_dir)} --out scene.html")
    return 0
