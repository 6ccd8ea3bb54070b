"""``dyngs export``: write a run as Gaussians in many formats, a page, tracks, an avatar, cameras, or a .dyngs file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli.arguments import (
    add_data_root,
    data_root,
    input_path,
    is_avatar_file,
    output_path,
    print_notes,
    run_of_scene_file,
    scene_time,
)
from dyngs.cli.splats import MOVING, SPLAT_FORMATS, add_axes, known_suffix, print_redrawn
from dyngs.errors import DyngsError, counted

if TYPE_CHECKING:
    from dyngs.export.redrawn import Redrawn
    from dyngs.export.splat_files import Part
    from dyngs.gaussians.scene import GaussianScene
    from dyngs.runs.opened import Opened
    from dyngs.splats.formats import Written

_OTHER_SUFFIXES = {f".{MOVING}": MOVING, ".npz": "tracks", ".safetensors": "avatar", ".dyngs": "dyngs"}
_OTHER_SUFFIXES |= {".html": "html", ".json": "cameras"}

_TIMES, _PARTS, _AXES = ("time", "times"), ("static", "dynamic"), ("up", "from_up", "sh_degree")
_FOR_DYNGS = {"max_change": "it goes with --format dyngs"}
_FOR_SPLATS = dict.fromkeys(_AXES, "it goes with files of Gaussians")
_UNFIT: dict[str, dict[str, str]] = {
    "cameras": dict.fromkeys((*_TIMES, "motion", "max_change", *_PARTS, *_AXES), ""),
    "html": {
        "times": "the page plays the whole clip",
        **dict.fromkeys(_PARTS, "the page shows the whole scene"),
        **_FOR_DYNGS,
        "up": "the page turns with the scene; --from-up names its axis",
        "sh_degree": "the page has the colours of the run",
    },
    "mesh": dict.fromkeys((*_TIMES, *_PARTS, *_AXES), "the file has the rest pose, y up") | _FOR_DYNGS,
    "dyngs": dict.fromkeys((*_TIMES, "motion", *_PARTS), "it stores the full run") | _FOR_SPLATS,
    "avatar": dict.fromkeys((*_TIMES, "motion", *_PARTS), "it is the same in all poses") | _FOR_SPLATS,
    "tracks": _FOR_SPLATS,
}
"""Options that do not go with a format, and why."""

_EPILOG = """\
examples:
  dyngs export runs/bench                                         runs/bench/splats.ply
  dyngs export runs/dance --time 0.5 --out middle.ply             the scene at one time
  dyngs export runs/bench --out bench.spz                         the suffix names the format: .glb, .sog, .splat ...
  dyngs export runs/dance --times 0:1:30 --out frames             frame_0000.ply ... for players of sequences
  dyngs export runs/dance --out dance.4dgs                        all training times in one file
  dyngs export runs/dance --static --out stage.ply                only the Gaussians that never move
  dyngs export runs/ann --motion walk.npz --out walk              a person (model.kind=human), one file per frame
  dyngs export runs/ann --format avatar --out ann.safetensors     a person as one file, for `render` and `export`
  dyngs export runs/ann --format mesh --motion walk.npz --out ann.glb   skinned and textured, for Blender, three.js ...
  dyngs export runs/ann --joints --out ann.ply                    Gaussians of a person with joints and weights
  dyngs export runs/dance --format tracks --dynamic               positions of all moving Gaussians over time, as .npz
  dyngs export runs/dance --format dyngs --out dance_export       a small file, for `eval`, `render` and `export`
  dyngs export runs/refined --format cameras                      runs/refined/cameras/transforms.json
  dyngs export runs/dance --out dance.html                        a page that plays in any browser, offline
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``export`` to the commands."""
    parser = commands.add_parser(
        "export",
        help="write a run as .ply, .spz, .glb and the like, tracks, avatar, mesh, small .dyngs file, page or cameras",
        description="Write the Gaussians of a run as files that viewers and editors read, as tracks of their centres, "
        "as one small .dyngs file, as a page that plays by itself, a person as an avatar or a mesh, or the cameras.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run_dir", type=input_path, metavar="RUN", help="run folder, or an avatar file (.safetensors)")
    parser.add_argument(
        "--format",
        choices=(*SPLAT_FORMATS, MOVING, "tracks", "dyngs", "avatar", "mesh", "html", "cameras"),
        help="file format (default: what the suffix of --out names, else ply)",
    )
    parser.add_argument(
        "--out", type=output_path, metavar="PATH", help="file, or folder of a sequence (default: splats... in RUN)"
    )
    when = parser.add_mutually_exclusive_group()
    when.add_argument("--time", type=scene_time, metavar="T", help="time to export, from 0 to 1 (default 0)")
    when.add_argument("--times", metavar="A:B:N", help="N times from A to B (tracks: default the training times)")
    parser.add_argument(
        "--motion",
        type=input_path,
        metavar="FILE",
        help="motion for a person: .npz (AMASS, SMPL-X), .bvh, .glb, .gltf, .vrma",
    )
    parser.add_argument(
        "--max-change",
        type=float,
        metavar="X",
        help="--format dyngs: largest root-mean-square change of the images, in grey levels of 255 "
        "(default: what lowers the PSNR of training views by 0.025 dB)",
    )
    parser.add_argument(
        "--joints", action="store_true", help="a person at rest, with joints and skinning weights: .ply, .glb"
    )
    add_axes(parser)
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--static", action="store_true", help="only the Gaussians that never move")
    part.add_argument("--dynamic", action="store_true", help="only the Gaussians that move")
    add_data_root(parser)
    parser.set_defaults(run=run)


def _require_fitting(arguments: argparse.Namespace, kind: str) -> None:
    """Raise for the first option that does not go with a format, with the reason."""
    wanted = "--joints" if arguments.joints else f"--format {kind}"
    for name, reason in _UNFIT.get("mesh" if arguments.joints else kind, {}).items():
        given = getattr(arguments, name)
        if given is not None and given is not False:  # a time may be 0
            raise DyngsError(f"--{name.replace('_', '-')} does not go with {wanted}{reason and f': {reason}'}")


def run(arguments: argparse.Namespace) -> int:
    """Write the files and print where they are and how large."""
    from dyngs.cli.export_cameras import export_cameras
    from dyngs.cli.export_html import export_page
    from dyngs.cli.export_rigged import export_rigged
    from dyngs.runs.opened import open_scene

    arguments.run_dir = run_of_scene_file(arguments.run_dir)
    kind = _kind(arguments)
    _require_fitting(arguments, kind)
    if kind == "mesh" or arguments.joints:
        return export_rigged(arguments, kind)
    if kind == "html":
        return export_page(arguments)
    if kind == "cameras":
        return export_cameras(arguments)
    is_file = is_avatar_file(arguments.run_dir)
    if is_file and (arguments.out is None or kind in ("dyngs", "avatar")):
        raise DyngsError(f"{arguments.run_dir}: an avatar file is exported as Gaussians or tracks, with --out PATH")
    if kind == "avatar":
        return _export_avatar(arguments)
    if kind == "dyngs":
        return _export_dyngs(arguments)
    if arguments.max_change is not None:
        raise DyngsError("--max-change goes with --format dyngs")
    if kind == "tracks" and arguments.static:
        raise DyngsError("--static goes with --format ply; Gaussians that never move have no tracks")
    times = _times(arguments)
    opened = open_scene(arguments.run_dir, data_root=data_root(arguments))
    if arguments.motion is not None:
        opened = opened.in_motion(arguments.motion)
        times = opened.scene.times if times is None else times
    if opened.scene.is_static and times is not None:
        print_notes(("nothing moves in this run: it is the same at all times",))
    if kind == "tracks":
        files = _export_tracks(arguments, opened, times)
    elif kind == MOVING:
        files = _export_moving(arguments, opened, times or opened.scene.times or (0.0,))
    else:
        files = _export_splats(arguments, opened, times, kind)
    size = sum(path.stat().st_size for path in files) / 1e6
    where = files[0] if len(files) == 1 else f"{len(files)} files, {files[0]} to {files[-1].name}"
    print(f"written: {where} ({size:.1f} MB)")
    return 0


def _kind(arguments: argparse.Namespace) -> str:
    """Return the name of the format: what --format says, else what the suffix of --out names, else ply.

    Raises:
        DyngsError: an unknown suffix, or one of another format than --format.
    """
    from dyngs.splats.formats import all_suffixes, known_format

    out, given = arguments.out, arguments.format
    if out is None or out.is_dir():
        return given or "ply"
    found = known_format(out)
    named = _OTHER_SUFFIXES.get(out.suffix.lower()) if found is None else found.name
    if given == "mesh" and named == "glb":
        return given
    if given is None and named is None:
        is_sequence = arguments.times is not None or (arguments.motion is not None and arguments.time is None)
        if is_sequence and not out.suffix:
            return "ply"
        known = f"{all_suffixes()}, {', '.join(_OTHER_SUFFIXES)}"
        raise DyngsError(f"{out}: which format? Give --format, or a name that ends in one of {known}")
    if given is not None and named is not None and given != named:
        raise DyngsError(f"{out}: --format {given} does not write files of that suffix, which is that of {named}")
    if given is not None and named is None and out.suffix and given in SPLAT_FORMATS:
        raise DyngsError(f"{out}: viewers do not know this suffix as {given}; use one of {all_suffixes()}")
    return given or named or "ply"


def _export_dyngs(arguments: argparse.Namespace) -> int:
    """Write the run as a .dyngs file and print how much its images change."""
    from dyngs.export.scene_file import write_scene_file
    from dyngs.storage.measure import SMALLEST_CHANGE

    max_change: float | None = arguments.max_change
    if max_change is not None and not SMALLEST_CHANGE <= max_change <= 64:
        raise DyngsError(f"--max-change {max_change:g}: give {SMALLEST_CHANGE:g} to 64 grey levels of 255")
    out: Path = arguments.out or arguments.run_dir
    if out.suffix == ".dyngs":
        raise DyngsError(
            f"{out}: --format dyngs writes a folder (config.yaml and scene.dyngs); give --out {out.with_suffix('')}"
        )
    written = write_scene_file(arguments.run_dir, out, max_change, data_root=data_root(arguments))
    change = written.precision.change
    if change is None:
        warning = (
            "the capture cannot be read: quantisation steps are fixed, and the change of images is not measured; if it "
            "was moved, add data.root=FOLDER"
        )
        print_notes((), (warning,))
    else:
        note = f"images change by {change:.2f} grey levels of 255 (root mean square over some training views)"
        print_notes((note,))
    ratio = written.num_bytes_exact / written.num_bytes
    print(f"written: {written.path} ({written.num_bytes / 1e6:.2f} MB, {ratio:.1f} times smaller than before)")
    return 0


def _export_avatar(arguments: argparse.Namespace) -> int:
    """Write the person of a run as an avatar file."""
    from dyngs.runs.avatar import write_avatar
    from dyngs.runs.checkpoint import load_run

    path = write_avatar(load_run(arguments.run_dir), arguments.out or arguments.run_dir / "avatar.safetensors")
    print(f"written: {path} ({path.stat().st_size / 1e6:.1f} MB)")
    return 0


def _times(arguments: argparse.Namespace) -> tuple[float, ...] | None:
    """Return the times asked for, clamped to [0, 1], or None."""
    from dyngs.camera_paths.path import parse_times
    from dyngs.evaluate.temporal import clamped_times

    if arguments.times is None and arguments.time is None:
        return None
    inside, warnings = clamped_times((arguments.time,) if arguments.times is None else parse_times(arguments.times))
    print_notes((), warnings)
    return inside


def _export_splats(
    arguments: argparse.Namespace, opened: Opened, times: tuple[float, ...] | None, kind: str
) -> list[Path]:
    """Write a sequence if several times of a moving scene are asked for, else one file; return the paths."""
    from dyngs.export.splat_files import scene_part, write_run_sequence, write_run_splats, writing_of
    from dyngs.splats.formats import format_named

    own = format_named(kind)
    suffix = own.suffixes[0]
    if opened.scene.colour is not None:
        print_notes(("the colours of the run are a network; spherical harmonics of degree 3 are fitted to it",))
    part = _part(arguments)
    scene = scene_part(opened.scene, part)
    how, line = writing_of(opened, own.up, arguments.up, arguments.from_up, arguments.sh_degree)
    stem = "splats" + ("_static" if arguments.static else "_dynamic" if arguments.dynamic else "")
    out: Path | None = arguments.out
    is_sequence = arguments.times is not None or (arguments.motion is not None and arguments.time is None)
    is_file = out is not None and known_suffix(out)
    if is_sequence and is_file and not arguments.static:
        raise DyngsError(f"{out}: a sequence is a folder of files; give --out DIR, or --time for one file")
    print_notes((line,))
    if is_sequence and not arguments.static:
        moments = times or ()
        written = write_run_sequence(opened, out or arguments.run_dir / stem, moments, part, how, suffix)
    else:
        if out is not None and not is_file and (out.is_dir() or is_sequence):
            out = out / f"{stem}{suffix}"
        if times is None and not arguments.static and not opened.scene.is_static:
            print_notes(("this is time 0 of a moving scene; --time T gives another one, --times 0:1:30 a sequence",))
        moments = (0.0 if times is None else times[0],)
        path = out or arguments.run_dir / f"{stem}{suffix}"
        written = [write_run_splats(opened, path, moments[0], part, how)]
    shown = sorted({0, len(written) // 2, len(written) - 1})
    print_redrawn(written[0].notes, [_redrawn(opened, scene, moments[i], written[i]) for i in shown])
    return [one.path for one in written]


def _part(arguments: argparse.Namespace) -> Part:
    return "still" if arguments.static else "moving" if arguments.dynamic else "all"


def _redrawn(opened: Opened, scene: GaussianScene, time: float, written: Written) -> Redrawn:
    """Return how a file differs from the scene."""
    from dyngs.export.redrawn import compare_run
    from dyngs.splats.formats import read_splats

    return compare_run(opened, scene, time, written.splat, read_splats(written.path))


def _export_moving(arguments: argparse.Namespace, opened: Opened, times: tuple[float, ...]) -> list[Path]:
    """Write all times as one file of moving Gaussians."""
    from dyngs.export.moving_file import SUFFIX, UP, read_moment, write_moving
    from dyngs.export.redrawn import compare_run
    from dyngs.export.splat_files import scene_part, writing_of

    if arguments.sh_degree is not None:
        raise DyngsError(f"--sh-degree does not go with --format {MOVING}, which holds no harmonics")
    how, line = writing_of(opened, UP, arguments.up, arguments.from_up)
    print_notes((line,))
    part, scene = _part(arguments), scene_part(opened.scene, _part(arguments))
    out = arguments.out or arguments.run_dir
    if not out.is_dir() and out.suffix.lower() != SUFFIX:
        raise DyngsError(f"{out}: players know these files by the suffix {SUFFIX}; give --out {out.name}{SUFFIX}")
    written = write_moving(opened, out / f"splats{SUFFIX}" if out.is_dir() else out, times, part, how)
    shown = sorted({0, len(times) // 2, len(times) - 1})
    found = [compare_run(opened, scene, times[i], written.splats[i], read_moment(written.path, i)) for i in shown]
    print_redrawn(written.notes, found)
    return [written.path]


def _export_tracks(arguments: argparse.Namespace, opened: Opened, times: tuple[float, ...] | None) -> list[Path]:
    from dyngs.export.tracks import tracks_of, write_tracks

    part = "moving" if arguments.dynamic else "all"
    tracks = tracks_of(opened.scene, times or opened.scene.times or (0.0,), opened.info.world_offset, part=part)
    count, moments, _ = tracks.positions.shape
    print_notes(
        (f"{counted(count, 'Gaussian')}, {int(tracks.moving.sum()):,} of them moving, at {counted(moments, 'time')}",)
    )
    return [write_tracks(arguments.out or arguments.run_dir / "tracks.npz", tracks)]
