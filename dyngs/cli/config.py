"""``dyngs config``: every key of a preset or a run, with its value, its default and what it means."""

from __future__ import annotations

import argparse

from dyngs.cli.arguments import input_path


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``config`` to the commands."""
    parser = commands.add_parser(
        "config",
        help="print all configuration keys of a preset or a run",
        description="Print the configuration of a preset, a YAML file or a run: every key with its value, its default "
        "and what it means. The output is a preset itself: save it, change it, train with it.",
    )
    parser.add_argument("source", type=input_path, metavar="CONFIG_OR_RUN", help="preset, YAML file or run folder")
    parser.add_argument("overrides", nargs="*", default=[], metavar="key=value", help="overrides, as for `dyngs train`")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the configuration."""
    from dyngs.config.listing import listing

    print(listing(arguments.source, arguments.overrides), end="")
    return 0
