"""``dyngs view``: view a run, a file or a folder of runs in a browser."""

from __future__ import annotations

import argparse
import threading

from dyngs.cli import arguments as args
from dyngs.cli.imports import heavy_imports
from dyngs.cli.output import print_lines, print_notes
from dyngs.core.errors import DyngsError

_EPILOG = """\
examples:
  dyngs view runs/bench                          serve http://localhost:8080/ until Ctrl-C
  dyngs view splats.ply --up=-y                  any supported file of Gaussians
  dyngs view runs                                choose between the runs of a folder
  dyngs view runs/ann --motion motions           a person with the motions in a folder
  dyngs view runs/bench --host 0.0.0.0           for other machines, with a token in the link

Requires viser: pip install 'dyngs[view]'.
"""


def add_parser(commands: args.Commands) -> None:
    about = "Serve an interactive viewer that compares a scene with the images of its capture."
    parser = args.add_command(
        commands, "view", run, "view a run or a file in a browser", about, _EPILOG
    )
    parser.add_argument(
        "source", type=args.input_path, metavar="RUN_OR_FILE", help="run, file, or a folder of runs"
    )
    add_serving_arguments(parser)
    about = "motion file for a person, or a folder of motion files"
    parser.add_argument("--motion", type=args.input_path, metavar="PATH", help=about)
    args.add_max_gaussians_drawn(
        parser, "large static scenes: maximum number of Gaussians drawn while the camera moves"
    )
    args.add_up(parser)
    args.add_threads(parser)
    args.add_device(parser)
    args.add_data_root(parser)


def add_serving_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the web server."""
    about = "address to listen on (default: this machine only); other addresses require a token"
    parser.add_argument("--host", default="127.0.0.1", help=about)
    kind = args.integer_type("a port", 1, 65535)
    parser.add_argument(
        "--port", type=kind, metavar="N", help="port (default: 8080, or the next that is free)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Serve the viewer until Ctrl-C."""
    from dyngs.view.server import require_viser

    require_viser()
    with heavy_imports():
        import torch

        from dyngs.view.controls import motion_files
        from dyngs.view.server import ServerOptions, Viewer
        from dyngs.view.source import load_first, open_source

    if arguments.threads > 0:
        torch.set_num_threads(arguments.threads)
    motions = motion_files(arguments.motion)
    device = args.computing_device(arguments.device)
    root = args.data_root(arguments)
    most = arguments.max_gaussians_drawn
    source = open_source(arguments.source, arguments.up, device, root, most)
    first = load_first(source)
    if motions and first.person is None:
        raise DyngsError(
            f"--motion requires a person (model.kind=human), but {first.name} is none; remove it"
        )
    print_notes(first.notes)
    serving = ServerOptions(arguments.host, arguments.port, motions)
    with Viewer(source, first, serving) as viewer:
        print_lines(f"viewing: {first.name}\n         {viewer.link}\n         press Ctrl-C to stop")
        wait_for_interrupt()
    print("\nviewer stopped")
    return 0


def wait_for_interrupt() -> None:
    """Return after Ctrl-C or SIGTERM."""
    import signal

    ended = threading.Event()
    before = {
        number: signal.signal(number, lambda *_: ended.set())
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        while not ended.wait(0.5):
            pass
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
