"""``dyngs config``: print all configuration keys of a preset or a run. ``dyngs presets``: list the
presets."""

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


def add_presets_parser(commands: Commands) -> None:
    add_command(commands, "presets", run_presets, "list the presets of `dyngs train`")


def run(arguments: argparse.Namespace) -> int:
    from dyngs.config.listing import format_config

    print(format_config(arguments.source, arguments.overrides), end="")
    return 0


def run_presets(_: argparse.Namespace) -> int:
    from dyngs.config.listing import preset_summaries

    summaries = preset_summaries()
    width = max(map(len, summaries))
    for name, summary in summaries.items():
        print(f"{name:<{width}}  {summary}")
    print("next: dyngs train PRESET PATH, or dyngs config PRESET for all keys")
    return 0
