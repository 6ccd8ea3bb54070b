"""``dyngs predict``: predict a person from a few images with a trained network."""

from __future__ import annotations

import argparse

from dyngs.cli.arguments import Commands, add_command, input_path, output_path
from dyngs.cli.output import ProgressBar, print_lines
from dyngs.core.errors import format_count, quote_path

_EPILOG = """\
examples:
  dyngs train human_predictor PEOPLE run.dir=runs/net     PEOPLE holds a capture in each folder
  dyngs predict runs/net captures/ann --out runs/ann
  dyngs predict runs/net captures/ann --out runs/ann --views f000_c00.png,f000_c03.png,f000_c06.png
  dyngs train gps PEOPLE run.dir=runs/stereo             from two neighbouring views, without a body
  dyngs export runs/stereo --format network --out stereo.safetensors  the weights as one file
  dyngs predict stereo.safetensors captures/ann --out runs/two --views f000_c00.png,f000_c01.png
  dyngs predict gps captures/ann --out runs/two                     with the weights of dyngs
  dyngs predict runs/keypoint_nerf captures/ann --out runs/field --views 4
  dyngs eval runs/ann
  dyngs train --resume runs/ann                                     continues from the prediction
"""


def add_parser(commands: Commands) -> None:
    parser = add_command(
        commands,
        "predict",
        run,
        "predict a person from a few images, without training",
        "Predict a person from one or a few training views of a capture with silhouettes. Networks "
        "of model.kind=human_predictor predict an avatar (a missing body is fitted first, as by "
        "`dyngs data fit`), gps the Gaussians of neighbouring views, others a radiance field. "
        "Writes a run folder.",
        _EPILOG,
    )
    about = (
        "run folder or weights file of a network, or gps or human_predictor, which come with dyngs"
    )
    parser.add_argument("network", type=input_path, metavar="NET", help=about)
    parser.add_argument("capture", type=input_path, metavar="CAPTURE", help="capture of a person")
    parser.add_argument(
        "--out", type=output_path, required=True, metavar="RUN", help="new run folder"
    )
    views = "number or names of the views to predict from (default: model.source_views of the network; gps: 2)"
    parser.add_argument("--views", type=parse_views, metavar="N|NAME,..", help=views)
    steps = "human_predictor: steps of fine-tuning the network on these images (default 10)"
    parser.add_argument("--steps", type=int, metavar="N", help=steps)


def parse_views(text: str) -> int | tuple[str, ...]:
    """Return a number of views, or their names."""
    if text.lstrip("-").isdigit():
        return int(text)
    return tuple(name.strip() for name in text.split(",") if name.strip())


def run(arguments: argparse.Namespace) -> int:
    """Predict, and print timings and the next commands."""
    from dyngs.api.predict import predict

    out = arguments.out
    with ProgressBar() as report:
        made = predict(
            arguments.network,
            arguments.capture,
            out,
            arguments.views,
            steps=arguments.steps,
            report=report,
        )
    trained = f", after {made.seconds_steps:.2f} s of fine-tuning" if made.steps else ""
    what = format_count(made.num_gaussians, "Gaussian") if made.num_gaussians else "a field"
    word = quote_path(out)
    # fields are not trained
    refine = f"\n           dyngs train --resume {word}   refines it" if made.num_gaussians else ""
    print_lines(
        f"predicted: {what} from {', '.join(made.views)}\n"
        f"time:      {made.seconds:.2f} s{trained}\n"
        f"written:   {out}\nnext:      dyngs eval {word}{refine}"
    )
    return 0
