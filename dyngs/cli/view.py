"""``dyngs view``: look at a run, a file or a folder of runs in a browser."""

from __future__ import annotations

import argparse
import threading

from dyngs.cli.arguments import add_data_root, add_device, computing_device, data_root, input_path, threads
from dyngs.errors import DyngsError

_EPILOG = """\
examples:
  dyngs view runs/bench                          opens http://localhost:8080/ (Ctrl-C ends it)
  dyngs view splats.ply --up=-y                  any file that dyngs reads
  dyngs view runs                                a folder of runs, with a picker
  dyngs view runs/ann --motion motions           a person, with the motions in a folder
  dyngs view runs/net --capture people           a network of people, and whom it may predict
  dyngs view runs/bench --host 0.0.0.0           for other machines; the link that is printed has a token

Needs viser: pip install 'dyngs[view]'. All controls are in docs/viewer.md.
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``view`` to the commands."""
    parser = commands.add_parser(
        "view",
        help="look at a run or a file in a browser",
        description="Serve a page that shows a scene from anywhere at any time, beside the truth of its capture.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("source", type=input_path, metavar="RUN_OR_FILE", help="run folder, file, or a folder of runs")
    add_serving_arguments(parser)
    parser.add_argument(
        "--motion", type=input_path, metavar="PATH", help="motion file for a person, or a folder of them"
    )
    parser.add_argument(
        "--capture",
        type=input_path,
        metavar="PATH",
        help="for a network of people: whom to predict, or a folder of people",
    )
    parser.add_argument(
        "--up",
        choices=("x", "y", "z", "-x", "-y", "-z"),
        help="up axis (default: up for the cameras of a run; of a file what it says, or what is usual for its format)",
    )
    parser.add_argument("--threads", type=threads, default=0, metavar="N", help="number of threads, 0 = all cores")
    add_device(parser)
    add_data_root(parser)
    parser.set_defaults(run=run)


def add_serving_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of how the page is served."""
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on (default: this machine only); others get a link with a token",
    )
    parser.add_argument("--port", type=port, metavar="N", help="port (default: 8080, or the next that is free)")


def port(text: str) -> int:
    """Return the number of a port."""
    if not (text.isascii() and text.isdigit() and len(text) < 6 and 1 <= int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"{text!r} is not a port; write a whole number from 1 to 65535")
    return int(text)


def run(arguments: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    from dyngs.view.server import require_viser

    require_viser()
    import torch

    from dyngs.view.people import motion_files
    from dyngs.view.server import Serving, Viewer
    from dyngs.view.source import first_of, open_source

    if arguments.threads > 0:
        torch.set_num_threads(arguments.threads)
    motions = motion_files(arguments.motion)
    device = computing_device(arguments.device)
    source = open_source(arguments.source, arguments.up, arguments.capture, device, data_root(arguments))
    first = first_of(source)
    if motions and first.person is None:
        raise DyngsError(f"--motion goes with a person (model.kind=human), {first.name} is none; leave it out")
    for note in first.notes:
        print(f"note: {note}")
    serving = Serving(arguments.host, arguments.port, motions)
    with Viewer(source, first, serving) as viewer:
        print(f"viewing: {first.name}\n         {viewer.link}\n         Ctrl-C ends it", flush=True)
        wait_for_interrupt()
    print("\nended")
    return 0


def wait_for_interrupt() -> None:
    """Return after Ctrl-C or SIGTERM."""
    import signal

    ended = threading.Event()
    before = {number: signal.signal(number, lambda *_: ended.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        while not ended.wait(0.5):
            pass
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
