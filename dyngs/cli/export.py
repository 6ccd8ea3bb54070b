"""``dyngs export``: write a run as Gaussians in many formats, a page, tracks, a person, cameras, or
a .dyngs file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli import arguments as args
from dyngs.cli.imports import heavy_imports
from dyngs.cli.output import print_notes, print_written
from dyngs.cli.splats import MOVING, SPLAT_FORMATS, add_axes, print_redrawn
from dyngs.core.errors import DyngsError, as_word, counted

if TYPE_CHECKING:
    from dyngs.data.capture import Split, View
    from dyngs.export.splat_files import Part
    from dyngs.runs.opened import Opened

_OTHER_SUFFIXES = {
    f".{MOVING}": MOVING,
    ".npz": "tracks",
    ".safetensors": "avatar",
    ".dyngs": "dyngs",
    ".html": "html",
    ".json": "cameras",
}
_WHOLE = "cameras mesh dyngs avatar network"
_UNFIT = {
    "time": _WHOLE,
    "times": f"{_WHOLE} html bodies",
    "motion": "cameras dyngs avatar network surface bodies",
    "static": f"{_WHOLE} html surface tracks bodies",
    "dynamic": f"{_WHOLE} html surface bodies",
    "up": f"{_WHOLE} html tracks",
    "from_up": f"{_WHOLE} tracks",
    "sh_degree": f"{_WHOLE} html surface tracks bodies {MOVING}",
    "compress": "mesh bodies",
    "joints": "bodies",
    "folder": "bodies",
}
"""Options, and the formats that they do not go with; ``mesh`` is that of a person, ``surface`` of
anything else."""
_ONLY = dict.fromkeys(("level", "segments", "cells"), ("surface", "mesh, not of a person"))
_ONLY |= {"folder": ("html sog", "html or sog"), "max_gaussians_drawn": ("html", "html --folder")}
_ONLY |= {
    "max_change": ("dyngs", "dyngs"),
    "spz_version": ("spz", "spz"),
    "compress": ("glb", "glb"),
}
"""Options, the formats that they go with, and how these are asked for."""

_EPILOG = """\
examples:
  dyngs export runs/bench                                         runs/bench/splats.ply
  dyngs export runs/dance --time 0.5 --out middle.ply             the scene at one time
  dyngs export runs/bench --out bench.spz                         the suffix names the format: .glb, .sog, .splat ...
  dyngs export runs/dance --times 0:1:30 --out frames             frame_0000.ply ... for players of sequences
  dyngs export runs/dance --out dance.4dgs                        all training times in one file
  dyngs export runs/balls --bodies --out balls.glb                balls that roll as animated nodes
  dyngs export runs/ann --motion walk.npz --out walk              a person (model.kind=human), one file per frame
  dyngs export runs/ann --format avatar --out ann.safetensors     a person as one file, for `render` and `export`
  dyngs export runs/ann --format mesh --motion walk.npz --out ann.glb   skinned and textured, for Blender, three.js ...
  dyngs export runs/bench --format mesh --out bench.glb           the surface, with colours of vertices
  dyngs export runs/ann --joints --out ann.ply                    Gaussians of a person with joints and weights
  dyngs export runs/dance --format tracks --dynamic               positions of all moving Gaussians over time, as .npz
  dyngs export runs/dance --format dyngs --out dance_export       a small file, for `eval`, `render` and `export`
  dyngs export runs/refined --format cameras                      runs/refined/cameras/transforms.json
  dyngs export runs/stereo --format network --out net.safetensors   the weights of a network, for `dyngs predict`
  dyngs export runs/dance --out dance.html                        a page that plays in any browser, offline
  dyngs export town.ply --format html --folder --out town         a large scene, fetched as it is looked at
  dyngs export town.ply --format sog --folder --out town_sog      the same for PlayCanvas and SuperSplat
"""


def add_parser(commands: args.Commands) -> None:
    parser = args.add_command(
        commands,
        "export",
        run,
        "write a run as .ply, .spz, .glb and the like, tracks, avatar, mesh, small .dyngs file, page or cameras",
        "Write the Gaussians of a run as files that viewers and editors read, as tracks of their centres, as one small "
        ".dyngs file, as a page that plays by itself, a person as an avatar or a mesh, or the cameras.",
        _EPILOG,
    )
    parser.add_argument(
        "run_dir",
        type=args.input_path,
        metavar="RUN",
        help="run folder, or an avatar (.safetensors)",
    )
    formats = (
        *SPLAT_FORMATS,
        MOVING,
        "tracks",
        "dyngs",
        "avatar",
        "mesh",
        "html",
        "cameras",
        "network",
    )
    about = "file format (default: what the suffix of --out names, else ply)"
    parser.add_argument("--format", choices=formats, help=about)
    about = "file, or folder of a sequence (default: splats... in RUN)"
    parser.add_argument("--out", type=args.output_path, metavar="PATH", help=about)
    when = parser.add_mutually_exclusive_group()
    when.add_argument(
        "--time", type=args.scene_time, metavar="T", help="time to export, from 0 to 1 (default 0)"
    )
    when.add_argument(
        "--times", metavar="A:B:N", help="N times from A to B (tracks: default the training times)"
    )
    args.add_motion(parser)
    args.add_keep_feet(parser)
    about = (
        "--format dyngs: largest root-mean-square change of the images, in grey levels of 255 (default: what costs "
        "0.025 dB on training views)"
    )
    parser.add_argument("--max-change", type=float, metavar="X", help=about)
    about = "--format mesh of a radiance field: density of the surface (default: 25 per half extent / 1.5)"
    parser.add_argument("--level", type=float, metavar="X", help=about)
    about = "--format mesh of Gaussians or a field: cells along the longest side of the scene (default 192)"
    kind = args.whole("a number of cells", 8, 1024)
    parser.add_argument("--cells", type=kind, metavar="N", help=about)
    about = "--format mesh of curved triangles: segments of an edge of each (default 6)"
    kind = args.whole("a number of segments", 1, 64)
    parser.add_argument("--segments", type=kind, metavar="N", help=about)
    about = "--format html, sog: a folder for a web server, of which a page or PlayCanvas fetches what is seen"
    parser.add_argument("--folder", action="store_true", help=about)
    args.add_most_drawn(
        parser, "--folder: so many Gaussians of an image are drawn at most, as on phones"
    )
    about = "a person at rest, with joints and skinning weights: .ply, .glb"
    parser.add_argument("--joints", action="store_true", help=about)
    about = "what moves rigidly as animated nodes of a .glb; the rest stands as at --time"
    parser.add_argument("--bodies", action="store_true", help=about)
    add_axes(parser)
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--static", action="store_true", help="only the Gaussians that never move")
    part.add_argument("--dynamic", action="store_true", help="only the Gaussians that move")
    args.add_data_root(parser)


def run(arguments: argparse.Namespace) -> int:
    """Write the files and print where they are and how large."""
    with heavy_imports():
        import dyngs.runs.opened  # noqa: F401

    args.require_motion_for_feet(arguments)
    arguments.run_dir = args.run_of_scene_file(arguments.run_dir)
    kind = _kind(arguments)
    kind = "surface" if kind == "mesh" and _has_surface(arguments) else kind
    _require_fitting(arguments, kind)
    writers = {
        "html": _export_page,
        "cameras": _export_cameras,
        "avatar": _export_avatar,
        "dyngs": _export_dyngs,
    }
    writers |= {"surface": _export_surface, "network": _export_network}
    if arguments.bodies:
        return _export_bodies(arguments)
    if kind == "mesh" or arguments.joints:
        return _export_rigged(arguments, kind)
    is_file = args.is_avatar_file(arguments.run_dir) and kind not in ("html", "cameras")
    if is_file and (arguments.out is None or kind in ("dyngs", "avatar")):
        raise DyngsError(
            f"{arguments.run_dir}: an avatar file is exported as Gaussians or tracks, with --out PATH"
        )
    if kind in writers:
        return writers[kind](arguments)
    times = _times(arguments)
    opened = _moved(arguments, _open(arguments))
    times = opened.scene.times if arguments.motion is not None and times is None else times
    if opened.scene.is_static and times is not None:
        print_notes(("nothing moves in this run: it is the same at all times",))
    if kind == "tracks":
        files = _export_tracks(arguments, opened, times)
    elif kind == MOVING:
        files = _export_moving(arguments, opened, times or opened.scene.times or (0.0,))
    else:
        files = _export_splats(arguments, opened, times, kind)
    print_written(*files)
    return 0


def _require_fitting(arguments: argparse.Namespace, kind: str) -> None:
    """Raise for the first option that does not go with a format."""
    unfit, shown = kind, f"format {'mesh' if kind == 'surface' else kind}"
    if arguments.bodies:
        unfit = shown = "bodies"
    elif arguments.joints:
        unfit, shown = "mesh", "joints"
    for name, formats in _UNFIT.items():
        passed = getattr(arguments, name)
        if unfit in formats.split() and passed is not None and passed is not False:
            raise DyngsError(f"--{name.replace('_', '-')} does not go with --{shown}")
    for name, (only, asked) in _ONLY.items():
        if kind not in only.split() and getattr(arguments, name) not in (None, False):
            raise DyngsError(f"--{name.replace('_', '-')} goes with --format {asked}")


def _kind(arguments: argparse.Namespace) -> str:
    """Return the name of the format: what --format says, else what the suffix of --out names, else
    ply.

    Raises DyngsError: an unknown suffix, or one of another format than --format.
    """
    from dyngs.io.formats.formats import all_suffixes, known_format

    out = arguments.out
    stated = arguments.format
    if out is None or out.is_dir():
        return stated or "ply"
    found = known_format(out)
    named = _OTHER_SUFFIXES.get(out.suffix.lower()) if found is None else found.name
    if (stated, named) == ("network", "avatar"):
        return "network"
    if stated == "mesh" and (named in ("glb", "ply") or out.suffix.lower() == ".obj"):
        return stated
    if stated is None and named is None:
        if _is_sequence(arguments) and not out.suffix:
            return "ply"
        known = f"{all_suffixes()}, {', '.join(_OTHER_SUFFIXES)}"
        raise DyngsError(
            f"{out}: which format? Give --format, or a name that ends in one of {known}"
        )
    if stated is not None and named is not None and stated != named:
        raise DyngsError(
            f"{out}: --format {stated} does not write files of that suffix, which is that of {named}"
        )
    if stated is not None and named is None and out.suffix and stated in SPLAT_FORMATS:
        raise DyngsError(
            f"{out}: viewers do not know this suffix as {stated}; use one of {all_suffixes()}"
        )
    return stated or named or "ply"


def _open(arguments: argparse.Namespace) -> Opened:
    from dyngs.runs.opened import open_scene

    return open_scene(arguments.run_dir, data_root=args.data_root(arguments))


def _is_sequence(arguments: argparse.Namespace) -> bool:
    return arguments.times is not None or (arguments.motion is not None and arguments.time is None)


def _moved(arguments: argparse.Namespace, opened: Opened) -> Opened:
    if getattr(opened.renderable, "sides", None) is not None:
        line = "of the sides that it was found from dyngs draws the one nearest to the camera, a file all: less sharply"
        print_notes((line,))
    return args.in_motion(arguments, opened)


def _times(arguments: argparse.Namespace) -> tuple[float, ...] | None:
    """Return the requested times, clamped to [0, 1], or None."""
    from dyngs.export.camera_paths import clamped_times, parse_times

    if arguments.times is None and arguments.time is None:
        return None
    inside, warnings = clamped_times(
        (arguments.time,) if arguments.times is None else parse_times(arguments.times)
    )
    print_notes((), warnings)
    return inside


def _part(arguments: argparse.Namespace) -> Part:
    return "still" if arguments.static else "moving" if arguments.dynamic else "all"


def _export_splats(
    arguments: argparse.Namespace, opened: Opened, times: tuple[float, ...] | None, kind: str
) -> list[Path]:
    """Write a sequence if several times of a moving scene are requested, else one file; return the
    paths."""
    from dyngs.export.images import compare_run
    from dyngs.export.splat_files import (
        scene_part,
        write_run_levels,
        write_run_sequence,
        write_run_splats,
        writing_of,
    )
    from dyngs.io.formats.formats import chosen_variant, format_named, known_format, read_splats

    own = format_named(kind)
    part = _part(arguments)
    suffix = own.suffixes[0]
    scene = scene_part(opened.scene, part)
    if opened.scene.colour is not None:
        print_notes(
            (
                "the colours of the run are a network; spherical harmonics of degree 3 are fitted to it",
            )
        )
    how, line = writing_of(opened, own.up, arguments.up, arguments.from_up, arguments.sh_degree)
    how = replace(how, own=chosen_variant(own, arguments.spz_version, arguments.compress))
    stem = "splats" + ("_static" if arguments.static else "_dynamic" if arguments.dynamic else "")
    out: Path | None = arguments.out
    is_sequence = _is_sequence(arguments)
    is_file = out is not None and known_format(out) is not None
    if is_sequence and is_file and not arguments.static:
        raise DyngsError(
            f"{out}: a sequence is a folder of files; give --out DIR, or --time for one file"
        )
    print_notes((line,))
    if arguments.folder:
        if is_file or is_sequence:
            raise DyngsError(
                f"{out}: --folder writes a folder of one time; give --out FOLDER, and --time T"
            )
        path = out or arguments.run_dir / "sog"
        counts, notes = write_run_levels(opened, path, (times or (0.0,))[0], part, how)
        levels = f"levels of {', '.join(f'{count:,}' for count in counts)} Gaussians"
        print_notes((*notes, f"{levels}; viewers open its lod-meta.json"))
        return [path]
    if is_sequence and not arguments.static:
        moments = times or ()
        written = write_run_sequence(
            opened, out or arguments.run_dir / stem, moments, part, how, suffix
        )
    else:
        if out is not None and not is_file and (out.is_dir() or is_sequence):
            out = out / f"{stem}{suffix}"
        if times is None and not arguments.static and not opened.scene.is_static:
            print_notes(
                (
                    "this is time 0 of a moving scene; --time T gives another, --times 0:1:30 a sequence",
                )
            )
        moments = (0.0 if times is None else times[0],)
        path = out or arguments.run_dir / f"{stem}{suffix}"
        written = [write_run_splats(opened, path, moments[0], part, how)]
    found = [
        compare_run(opened, scene, moments[i], written[i].splat, read_splats(written[i].path))
        for i in _shown(len(written))
    ]
    print_redrawn(written[0].notes, found)
    return [one.path for one in written]


def _shown(count: int) -> list[int]:
    """Return which of several files or times are drawn, to be compared with the scene."""
    return sorted({0, count // 2, count - 1})


def _export_moving(
    arguments: argparse.Namespace, opened: Opened, times: tuple[float, ...]
) -> list[Path]:
    """Write all times as one file of moving Gaussians."""
    from dyngs.export.images import compare_run
    from dyngs.export.splat_files import (
        SUFFIX,
        UP,
        read_moment,
        scene_part,
        write_moving,
        writing_of,
    )

    how, line = writing_of(opened, UP, arguments.up, arguments.from_up)
    print_notes((line,))
    part = _part(arguments)
    scene = scene_part(opened.scene, _part(arguments))
    out = arguments.out or arguments.run_dir
    if not out.is_dir() and out.suffix.lower() != SUFFIX:
        raise DyngsError(
            f"{out}: players know these files by the suffix {SUFFIX}; give --out {out.name}{SUFFIX}"
        )
    path = out / f"splats{SUFFIX}" if out.is_dir() else out
    splats, notes = write_moving(opened, path, times, part, how)
    found = [
        compare_run(opened, scene, times[i], splats[i], read_moment(path, i))
        for i in _shown(len(times))
    ]
    print_redrawn(notes, found)
    return [path]


def _export_tracks(
    arguments: argparse.Namespace, opened: Opened, times: tuple[float, ...] | None
) -> list[Path]:
    from dyngs.export.splat_files import tracks_of, write_tracks

    part = "moving" if arguments.dynamic else "all"
    tracks = tracks_of(opened.scene, times or opened.scene.times or (0.0,), opened.world, part=part)
    count, moments, _ = tracks.positions.shape
    moving = f"{int(tracks.moving.sum()):,} of them moving"
    print_notes((f"{counted(count, 'Gaussian')}, {moving}, at {counted(moments, 'time')}",))
    return [write_tracks(arguments.out or arguments.run_dir / "tracks.npz", tracks)]


def _export_dyngs(arguments: argparse.Namespace) -> int:
    """Write the run as a .dyngs file and print how much its images change."""
    from dyngs.api.scene_file import write_scene_file
    from dyngs.compress.measure import SMALLEST_CHANGE

    max_change: float | None = arguments.max_change
    if max_change is not None and not SMALLEST_CHANGE <= max_change <= 64:
        raise DyngsError(
            f"--max-change {max_change:g}: give {SMALLEST_CHANGE:g} to 64 grey levels of 255"
        )
    out: Path = arguments.out or arguments.run_dir
    if out.suffix == ".dyngs":
        raise DyngsError(
            f"{out}: --format dyngs writes a folder (config.yaml and scene.dyngs); give --out {out.with_suffix('')}"
        )
    written = write_scene_file(
        arguments.run_dir, out, max_change, data_root=args.data_root(arguments)
    )
    change = written.precision.change
    if change is None:
        warning = (
            "the capture cannot be read: quantisation steps are fixed, and the change of images is not measured; if it "
            "was moved, add data.root=FOLDER"
        )
        print_notes((), (warning,))
    else:
        print_notes(
            (f"images change by {change:.2f} grey levels of 255 (rms over some training views)",)
        )
    ratio = written.num_bytes_exact / written.num_bytes
    print(
        f"written: {written.path} ({written.num_bytes / 1e6:.2f} MB, {ratio:.1f} times smaller than before)"
    )
    return 0


def _export_avatar(arguments: argparse.Namespace) -> int:
    from dyngs.human.avatar.avatar_file import write_avatar
    from dyngs.runs.inputs import inputs_of
    from dyngs.runs.opened import open_run

    path = arguments.out or arguments.run_dir / "avatar.safetensors"
    run = open_run(arguments.run_dir).in_own_frame()
    inputs_of(run).require_output(path)
    print_written(write_avatar(run.renderable, run.config.model, run.info, path))
    return 0


def _export_network(arguments: argparse.Namespace) -> int:
    from dyngs.api.predict import network_config
    from dyngs.runs.checkpoint import latest_checkpoint
    from dyngs.runs.network_file import SUFFIX, write_network

    run: Path = arguments.run_dir
    out = arguments.out or run / f"network{SUFFIX}"
    print_written(write_network(run, network_config(run), latest_checkpoint(run), out))
    return 0


def _export_bodies(arguments: argparse.Namespace) -> int:
    """Write a moving scene with its bodies as animated nodes."""
    from dyngs.export.images import compare_run
    from dyngs.export.splat_files import write_bodies, writing_of
    from dyngs.io.formats.formats import format_named, read_splats

    if arguments.format not in (None, "glb"):
        raise DyngsError(f"--bodies goes with --format glb, not with {arguments.format}")
    out: Path = arguments.out or arguments.run_dir / "bodies.glb"
    if out.is_dir() or out.suffix.lower() != ".glb":
        name = out / "bodies.glb" if out.is_dir() else f"{out.stem}.glb"
        raise DyngsError(f"{out}: --bodies writes one file; give --out {name}")
    opened = _open(arguments)
    time = (_times(arguments) or (0.0,))[0]
    how, line = writing_of(opened, format_named("glb").up, arguments.up, arguments.from_up)
    written = write_bodies(opened, out, time, how)
    print_notes((line,))
    found = compare_run(opened, opened.scene, time, written.splat, read_splats(written.path))
    print_redrawn(written.notes, [found])
    print_written(written.path)
    return 0


def _export_rigged(arguments: argparse.Namespace, kind: str) -> int:
    """Write a person as a skinned mesh, or as Gaussians with joints."""
    from dyngs.export.rigged.people import Played, write_mesh, write_rigged_splats
    from dyngs.runs.opened import FRAME_RATE

    option, stem = ("--joints", "rigged") if arguments.joints else ("--format mesh", "mesh")
    if arguments.joints and kind not in ("ply", "glb"):
        raise DyngsError(f"--joints goes with --format ply and glb, not with {kind}")
    suffix = ".ply" if kind == "ply" else ".glb"
    source: Path = arguments.run_dir
    if args.is_avatar_file(source) and arguments.out is None:
        raise DyngsError(f"{source}: where to? Give --out FILE{suffix}")
    out: Path = arguments.out or source / f"{stem}{suffix}"
    if out.is_dir() or out.suffix.lower() != suffix:
        name = out / f"{stem}{suffix}" if out.is_dir() else f"{out.stem}{suffix}"
        raise DyngsError(f"{out}: {option} writes one file; give --out {name}")
    if suffix == ".ply" and arguments.motion is not None:
        raise DyngsError(
            "--motion does not go with --joints in a .ply, which has the rest pose; give --out FILE.glb"
        )
    opened = _moved(arguments, _open(arguments)).in_own_frame()
    played = (
        Played(arguments.motion.stem, opened.fps or FRAME_RATE)
        if arguments.motion is not None
        else None
    )
    print_notes((write_rigged_splats if arguments.joints else write_mesh)(opened, out, played))
    print_written(out)
    return 0


def _has_surface(arguments: argparse.Namespace) -> bool:
    """Return whether the run is of something whose surface is looked for: all but people, who have
    a body."""
    from dyngs.config.io import load_resolved

    source: Path = arguments.run_dir
    if source.is_file() and not args.is_avatar_file(source):
        raise DyngsError(
            f"{source}: a file has no training views, whose depths make a surface; give the run"
        )
    from dyngs.models.kind import HasBody, capability

    return source.is_dir() and capability(load_resolved(source).model, HasBody) is None


def _export_surface(arguments: argparse.Namespace) -> int:
    """Write the surface of a scene, at several times one file each."""
    from dyngs.export.surface_file import upright_surface, write_surface
    from dyngs.gaussians.surface import num_holes
    from dyngs.models.renderable import SurfaceOptions

    out: Path = arguments.out or arguments.run_dir / ("mesh" if arguments.times else "mesh.ply")
    if arguments.times and out.suffix:
        raise DyngsError(
            f"{out}: a sequence is a folder of files; give --out {out.with_suffix('')}, or --time for one"
        )
    opened = _open(arguments)
    options = SurfaceOptions(arguments.level, arguments.cells, arguments.segments)
    how, line = upright_surface(
        opened, ".ply" if arguments.times else out.suffix, arguments.up, arguments.from_up
    )
    print_notes((line,))
    for i, time in enumerate(_times(arguments) or (0.0,)):
        path = out / f"mesh_{i:04d}.ply" if arguments.times else out
        surface = write_surface(opened, path, time=time, options=options, how=how)
        holes = num_holes(surface)
        closed = "closed" if holes == 0 else f"open at {counted(holes, 'place')}"
        faces = counted(len(surface.faces), "triangle")
        print_notes((f"{faces} with colours of {len(surface.vertices):,} vertices, {closed}",))
        print_written(path)
    return 0


def _export_page(arguments: argparse.Namespace) -> int:
    """Write a page that plays in a browser by itself, or a folder whose page fetches a scene as it
    is seen."""
    from dyngs.export.html.page import write_folder, write_page

    source: Path = arguments.run_dir
    most = arguments.max_gaussians_drawn
    folder = arguments.folder
    time = arguments.time or 0.0
    if most is not None and not folder:
        raise DyngsError("--max-gaussians-drawn goes with --folder")
    if arguments.out is None and not source.is_dir():
        raise DyngsError(f"{source}: where to? Give --out {'FOLDER' if folder else 'FILE.html'}")
    out: Path = arguments.out or source / ("scene" if folder else "scene.html")
    is_page = out.suffix.lower() in (".html", ".htm")
    if folder == is_page or (not folder and out.is_dir()):
        what, suffix = (
            ("--folder writes a folder", "")
            if folder
            else ("--format html writes one file", ".html")
        )
        raise DyngsError(f"{out}: {what}; give --out {out.with_suffix(suffix)}")
    opened = _moved(arguments, _open(arguments))
    opened = opened if arguments.from_up is None else replace(opened, stated_up=arguments.from_up)
    written = (
        write_folder(opened, out, most=most, time=time)
        if folder
        else write_page(opened, out, time=time)
    )
    served = f"for any web server, such as `python -m http.server -d {as_word(out)}`"
    print_notes(written.notes)
    where = served if folder else "it plays in any browser with WebGL 2, offline"
    print(f"written: {written.path} ({written.num_bytes / 1e6:.1f} MB); {where}")
    return 0


def _export_cameras(arguments: argparse.Namespace) -> int:
    """Write the cameras of a run as a transforms.json, refined where training refined them."""
    from dyngs.data.capture import all_views
    from dyngs.evaluate.report import found_corrections
    from dyngs.export.cameras import NAME, write_cameras
    from dyngs.runs.opened import open_run

    source: Path = arguments.run_dir
    if args.is_avatar_file(source):
        raise DyngsError(f"{source}: an avatar file has no cameras; give a run")
    out: Path = arguments.out or source / "cameras"
    path = out if out.suffix.lower() == ".json" else out / NAME
    run = open_run(source, data_root=args.data_root(arguments))
    capture = run.capture
    if path.resolve().parent == capture.root.resolve():
        raise DyngsError(
            f"{path}: would stand in for the cameras of the capture; give another folder"
        )
    found = found_corrections(source, run, capture.splits["train"])
    if found is None and run.config.camera.refine == "always":
        raise DyngsError(
            f"{source}: refined cameras lie in checkpoints, and there is none; restore one or train again"
        )
    splits: dict[Split, Sequence[View]] = {
        name: views for name, views in capture.splits.items() if name != "pose"
    }
    if found is None:
        print_notes(
            ("camera.refine was not used in this run: these are the cameras of the capture",)
        )
    else:
        splits = {
            name: [found.corrected_view(view) for view in views] for name, views in splits.items()
        }
        print_notes(
            (
                "training cameras as training found them; others have the capture's poses, and known lenses",
            )
        )
    written = write_cameras(path, capture, splits, run.world)
    count = counted(len(all_views(capture.splits)), "camera")
    root = as_word(path.parent)
    print(
        f"written: {written} ({count}); `data.root={root} data.follow_links=true` trains with them"
    )
    return 0
