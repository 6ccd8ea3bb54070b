"""``dyngs config``: print all configuration keys of a preset or a run."""

from __future__ import annotations

import argparse

from dyngs.cli.arguments import Commands, add_command, add_overrides, input_path


def add_parser(commands: Commands) -> None:
    about = (
        "Print all configuration keys of a preset, a YAML file or a run with value, default and "
        "description. The output is a valid preset, to be saved, edited and trained with."
    )
    parser = add_command(
        commands, "config", run, "print all configuration keys of a preset or a run", about
    )
    parser.add_argument(
        "source", type=input_path, metavar="CONFIG_OR_RUN", help="preset, YAML file or run folder"
    )
    add_overrides(parser, "key=value", "overrides, as for `dyngs train`")


def run(arguments: argparse.Namespace) -> int:
    from dyngs.config.listing import format_config

    print(format_config(arguments.source, arguments.overrides), end="")
    return 0
