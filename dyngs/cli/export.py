"""``dyngs export``: export a run as Gaussians, mesh, web page, tracks, avatar, cameras or .dyngs
file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any

from dyngs.cli import arguments as args
from dyngs.cli.imports import heavy_imports
from dyngs.cli.output import ProgressBar, print_notes, print_written
from dyngs.cli.splats import MOVING, SPLAT_FORMATS, add_axes, print_image_difference
from dyngs.core.errors import DyngsError, format_count, quote_path
from dyngs.core.plugins import EXPORTERS, load_plugin, plugin_entries

if TYPE_CHECKING:
    from dyngs.data.capture import Split, View
    from dyngs.export.splat_files import Part
    from dyngs.models.renderable import Renderable
    from dyngs.runs.opened import OpenedScene

_OTHER_SUFFIXES = {
    f".{MOVING}": MOVING,
    ".npz": "tracks",
    ".safetensors": "avatar",
    ".dyngs": "dyngs",
    ".html": "html",
    ".json": "cameras",
    ".obj": "mesh",
}
_SPLATS = "time times motion static dynamic up from_up"
_TAKES = dict.fromkeys(SPLAT_FORMATS, f"{_SPLATS} sh_degree classic") | {
    "sog": f"{_SPLATS} sh_degree classic folder",
    MOVING: _SPLATS,
    "tracks": "time times motion dynamic",
    "dyngs": "max_change",
    "avatar": "",
    "network": "",
    "cameras": "",
    "html": "time motion from_up folder max_gaussians_drawn title view",
    "mesh of a person": "motion",
    "mesh": "time times up from_up level cells",
    "bodies": "time up from_up classic",
}
"""Options that each format accepts."""

_EPILOG = """\
examples:
  dyngs export runs/bench                                         runs/bench/splats.ply
  dyngs export runs/dance --time 0.5 --out middle.ply             the scene at one time
  dyngs export runs/bench --out bench.spz                         the suffix selects the format: .glb, .sog ...
  dyngs export runs/dance --times 0:1:30 --out frames             a sequence frame_0000.ply ...
  dyngs export runs/dance --out dance.4dgs                        all training times in one file
  dyngs export runs/balls --bodies --out balls.glb                rolling balls as animated nodes
  dyngs export runs/ann --motion walk.npz --out walk              a person (model.kind=human), one file per frame
  dyngs export runs/ann --format avatar --out ann.safetensors     an avatar file, for `render` and `export`
  dyngs export runs/ann --format mesh --motion walk.npz --out ann.glb   skinned and textured, for Blender, three.js ...
  dyngs export runs/bench --format mesh --out bench.glb           a mesh with vertex colours
  dyngs export runs/dance --format tracks --dynamic               positions of all moving Gaussians over time, as .npz
  dyngs export runs/dance --format dyngs --out dance_export       a small file, for `eval`, `render` and `export`
  dyngs export runs/refined --format cameras                      runs/refined/cameras/transforms.json
  dyngs export runs/stereo --format network --out net.safetensors   network weights, for `dyngs predict`
  dyngs export runs/dance --out dance.html                        a web page that works offline
  dyngs export town.ply --format html --folder --out town         a large scene, streamed on demand
  dyngs export town.ply --format sog --folder --out town_sog      the same for PlayCanvas and SuperSplat
"""


def add_parser(commands: args.Commands) -> None:
    parser = args.add_command(
        commands,
        "export",
        run,
        "export a run as .ply, .spz, .glb ..., mesh, web page, tracks, avatar, cameras or .dyngs "
        "file",
        "Export a run: Gaussians in the formats of other viewers and editors, tracks of their "
        "centres, a mesh, a web page, a compressed .dyngs file, an avatar, or the cameras.",
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
    about = "file format (default: from the suffix of --out, else ply)"
    parser.add_argument("--format", choices=formats, help=about)
    about = "file, or folder of a sequence (default: splats.ply and the like in RUN)"
    parser.add_argument("--out", type=args.output_path, metavar="PATH", help=about)
    when = parser.add_mutually_exclusive_group()
    when.add_argument(
        "--time", type=args.scene_time, metavar="T", help="time to export, from 0 to 1 (default 0)"
    )
    when.add_argument(
        "--times", metavar="A:B:N", help="N times from A to B (default for tracks: training times)"
    )
    args.add_motion(parser)
    about = (
        "--format dyngs: largest RMS change of the images, in grey levels of 255 (default: a loss "
        "of 0.025 dB on training views)"
    )
    parser.add_argument("--max-change", type=float, metavar="X", help=about)
    about = "--format mesh of a radiance field: density of the surface (default: 25 / (half extent / 1.5))"
    parser.add_argument("--level", type=float, metavar="X", help=about)
    about = "--format mesh: grid cells along the longest side of the scene (default 192)"
    kind = args.integer_type("a number of cells", 8, 1024)
    parser.add_argument("--cells", type=kind, metavar="N", help=about)
    about = "--format html, sog: write a folder for a web server, streamed on demand"
    parser.add_argument("--folder", action="store_true", help=about)
    args.add_max_gaussians_drawn(
        parser, "--folder: maximum number of Gaussians drawn per image, for example for phones"
    )
    about = "--format html: title of the page (default: name of the run)"
    parser.add_argument("--title", metavar="TEXT", help=about)
    about = (
        "--format html: view of the capture that the page starts with, by name or index (default 0)"
    )
    parser.add_argument("--view", metavar="NAME|N", help=about)
    about = "rigidly moving bodies as animated nodes of a .glb; all else is static, as at --time"
    parser.add_argument("--bodies", action="store_true", help=about)
    add_axes(parser)
    about = (
        "fit opacities, scales and (without SH) colours to viewers without antialiasing (default: "
        "only for .splat, .glb and USD, which cannot store that a scene is antialiased)"
    )
    parser.add_argument("--classic", action=argparse.BooleanOptionalAction, help=about)
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--static", action="store_true", help="only the Gaussians that never move")
    part.add_argument("--dynamic", action="store_true", help="only the Gaussians that move")
    args.add_data_root(parser)


def run(arguments: argparse.Namespace) -> int:
    """Write the files and print their paths and sizes."""
    print_written(*_write(arguments))
    return 0


def export(
    run: Path | str | Renderable, out: Path | str | None = None, **options: Any
) -> list[Path]:
    """Export a run, an avatar or a scene that was loaded from a run. Returns the written paths.

    Does what ``dyngs export`` does, but prints nothing. ``dyngs.save`` writes scenes in memory.

    Example:

        import dyngs

        dyngs.export("runs/lego", "lego.spz", sh_degree=0)
        dyngs.export("runs/lego", "lego.glb", format="mesh", cells=32)

    Args:
        run: run folder, file, or scene.
        out: file or folder; None: a name in the run folder.
        options: those of ``dyngs export``, with underscores, such as ``format="mesh"``,
            ``time=0.5``, ``times="0:1:30"``, ``motion="walk.npz"`` or ``folder=True``.

    Raises:
        DyngsError: an unknown option, one that the format does not have, or a file that cannot be
            written.
    """
    from dyngs.cli import make_parser
    from dyngs.models.renderable import run_path

    words = ["export", "--out", str(out)] if out else ["export"]
    for name, value in options.items():
        flag = f"--{name.replace('_', '-')}"
        if value is not None and value is not False:
            words.append(flag if value is True else f"{flag}={value}")
    arguments = make_parser("export").parse_args([*words, "--", str(run_path(run))])
    unknown = options.keys() - vars(arguments).keys()  # argparse accepts abbreviations
    if unknown:
        raise DyngsError(f"{min(unknown)}: no option of dyngs.export; see `dyngs export --help`")
    args.require_outputs_apart(arguments.parser, arguments)
    return _write(arguments)


def _write(arguments: argparse.Namespace) -> list[Path]:
    """Write the files and return their paths."""
    with heavy_imports():
        import dyngs.runs.opened  # noqa: F401

    arguments.run_dir = args.run_of_scene_file(arguments.run_dir)
    kind = _kind(arguments)
    if kind == "mesh" and not _has_surface(arguments):
        kind = "mesh of a person"
    elif arguments.bodies and kind == "glb":
        kind = "bodies"
    taken = {*_TAKES.get(kind, "time motion").split(), kind}
    for name in (*dict.fromkeys(" ".join(_TAKES.values()).split()), "bodies"):
        given = getattr(arguments, name)
        if name not in taken and given is not None and given is not False:
            raise DyngsError(f"--{name.replace('_', '-')} is not supported with --format {kind}")
    if args.is_avatar_file(arguments.run_dir) and kind in ("dyngs", "avatar", "network"):
        raise DyngsError(
            f"{arguments.run_dir}: avatar files can be exported as Gaussians, mesh, page or tracks"
        )
    writers = {
        "html": _export_page,
        "cameras": _export_cameras,
        "avatar": _export_avatar,
        "dyngs": _export_dyngs,
        "mesh": _export_surface,
        "network": _export_network,
        "bodies": _export_bodies,
        "mesh of a person": _export_person,
    }
    if kind not in _TAKES:
        return _export_by_plugin(arguments, kind[1:])
    if kind in writers:
        return writers[kind](arguments)
    times = _times(arguments)
    opened = _moved(arguments, _open(arguments))
    times = opened.scene.times if arguments.motion is not None and times is None else times
    if opened.scene.is_static and times is not None:
        print_notes(("the scene is static: all times are the same",))
    if kind == "tracks":
        return _export_tracks(arguments, opened, times)
    if kind == MOVING:
        return _export_moving(arguments, opened, times or opened.scene.times or (0.0,))
    return _export_splats(arguments, opened, times, kind)


def _kind(arguments: argparse.Namespace) -> str:
    """Return the format from --format, else from the suffix of --out, else ply.

    Raises DyngsError: an unknown suffix, or a suffix that contradicts --format.
    """
    from dyngs.export.video import WRITTEN_SUFFIXES
    from dyngs.io.formats.formats import all_suffixes, find_format

    out = arguments.out
    if out is not None and out.suffix.lower() in WRITTEN_SUFFIXES:
        run = quote_path(arguments.run_dir)
        raise DyngsError(f"{out}: a video; use `dyngs render {run} --out {quote_path(out)}`")
    stated = arguments.format
    usual = stated or ("glb" if arguments.bodies else "ply")
    if out is None or out.is_dir():
        return usual
    found = find_format(out)
    suffix = out.suffix.lower()
    named = _OTHER_SUFFIXES.get(suffix) if found is None else found.name
    if named is None and suffix[1:] in plugin_entries(EXPORTERS):
        named = suffix
    if stated is None and (named or (_is_sequence(arguments) and not out.suffix)):
        return named or "ply"
    fits = named in (None, stated) and not (
        out.suffix and named is None and stated in SPLAT_FORMATS
    )
    if stated is None or not (
        fits or (stated, named) in (("network", "avatar"), ("mesh", "glb"), ("mesh", "ply"))
    ):
        known = f"{all_suffixes()}, {', '.join(_OTHER_SUFFIXES)}"
        raise DyngsError(
            f"{out}: unknown format; add --format, or a suffix: {known}"
            if stated is None
            else f"{out}: wrong suffix for --format {stated}"
        )
    return usual


def _export_by_plugin(arguments: argparse.Namespace, suffix: str) -> list[Path]:
    """Write a file by the exporter of another package: a function of scene, path and time."""
    from dyngs.io.write import atomic_file
    from dyngs.runs.folder import collect_inputs

    write = load_plugin(EXPORTERS, suffix, FunctionType)
    opened = _moved(arguments, _open(arguments))
    collect_inputs(opened).require_output(arguments.out)
    with atomic_file(arguments.out) as temporary:
        write(opened, temporary, (_times(arguments) or (0.0,))[0])
    return [arguments.out]


def _target(arguments: argparse.Namespace, name: str) -> Path:
    """Return the file to write: --out, or ``name`` in the folder --out or RUN.

    Raises DyngsError: no output file can be derived, or --out has another suffix.
    """
    out: Path = arguments.out or arguments.run_dir
    suffix = Path(name).suffix
    if out == arguments.run_dir and out.is_file():
        raise DyngsError(f"{out}: an output file is required; add --out FILE{suffix}")
    if out.is_dir():
        return out / name
    if out.suffix.lower() != suffix:
        raise DyngsError(f"{out}: must be a {suffix} file; use --out {out.stem}{suffix}")
    return out


def _open(arguments: argparse.Namespace) -> OpenedScene:
    from dyngs.runs.opened import open_scene

    return open_scene(arguments.run_dir, data_root=args.data_root(arguments))


def _is_sequence(arguments: argparse.Namespace) -> bool:
    return arguments.times is not None or (arguments.motion is not None and arguments.time is None)


def _moved(arguments: argparse.Namespace, opened: OpenedScene) -> OpenedScene:
    if getattr(opened.renderable, "sides", None) is not None:
        print_notes(
            (
                "the file holds the Gaussians of all source views, less sharp than dyngs, which "
                "draws those of the nearest view",
            )
        )
    return args.play_motion(arguments, opened)


def _times(arguments: argparse.Namespace) -> tuple[float, ...] | None:
    """Return the requested times, clamped to [0, 1], or None."""
    from dyngs.export.camera_paths import clamp_times, parse_times

    if arguments.times is None and arguments.time is None:
        return None
    inside, warnings = clamp_times(
        (arguments.time,) if arguments.times is None else parse_times(arguments.times)
    )
    print_notes((), warnings)
    return inside


def _part(arguments: argparse.Namespace) -> Part:
    return "static" if arguments.static else "moving" if arguments.dynamic else "all"


def _export_splats(
    arguments: argparse.Namespace, opened: OpenedScene, times: tuple[float, ...] | None, kind: str
) -> list[Path]:
    """Write a sequence for several times of a moving scene, else one file; return the paths."""
    from dyngs.export.images import compare_file_with_run
    from dyngs.export.splat_files import (
        choose_write_options,
        scene_part,
        write_run_levels,
        write_run_sequence,
        write_run_splats,
    )
    from dyngs.io.formats.formats import find_format, format_by_name, read_splats

    own = format_by_name(kind)
    part = _part(arguments)
    suffix = own.suffixes[0]
    scene = scene_part(opened.scene, part)
    if opened.scene.colour is not None:
        line = "the colour network of the run is approximated by spherical harmonics of degree 3"
        print_notes((line,))
    how, line = choose_write_options(
        opened, own.up, arguments.up, arguments.from_up, arguments.sh_degree
    )
    how = replace(how, classic=arguments.classic)
    stem = "splats" + ("_static" if arguments.static else "_dynamic" if arguments.dynamic else "")
    out: Path | None = arguments.out
    is_sequence = _is_sequence(arguments)
    is_file = out is not None and find_format(out) is not None
    if (arguments.folder and (is_file or is_sequence)) or (
        is_file and is_sequence and not arguments.static
    ):
        raise DyngsError(
            f"{out}: --times and --folder write a folder; use --out FOLDER, or --time T for one "
            "file"
        )
    print_notes((line,))
    if arguments.folder:
        path = out or arguments.run_dir / "sog"
        counts, notes = write_run_levels(opened, path, (times or (0.0,))[0], part, how)
        levels = f"levels of {', '.join(f'{count:,}' for count in counts)} Gaussians"
        print_notes((*notes, f"{levels}; viewers open its lod-meta.json"))
        return [path]
    if is_sequence and not arguments.static:
        moments = times or ()
        folder = out or arguments.run_dir / stem
        written = write_run_sequence(opened, folder, moments, part, how, suffix)
    else:
        if times is None and not arguments.static and not opened.scene.is_static:
            line = (
                "exporting time 0 of a moving scene; use --time T, or --times 0:1:30 for a sequence"
            )
            print_notes((line,))
        moments = (0.0 if times is None else times[0],)
        if out is None or (is_sequence and not is_file and not out.is_dir()):
            path = (out or arguments.run_dir) / f"{stem}{suffix}"
        else:
            path = out / f"{stem}{suffix}" if out.is_dir() else out
        written = [write_run_splats(opened, path, moments[0], part, how)]
    found = [
        compare_file_with_run(
            opened, scene, moments[i], written[i].splat, read_splats(written[i].path)
        )
        for i in _shown(len(written))
    ]
    print_image_difference(written[0].notes, found)
    return [one.path for one in written]


def _shown(count: int) -> list[int]:
    """Return the indices of the files or times that are rendered for comparison."""
    return sorted({0, count // 2, count - 1})


def _export_moving(
    arguments: argparse.Namespace, opened: OpenedScene, times: tuple[float, ...]
) -> list[Path]:
    """Write all times as one .4dgs file."""
    from dyngs.export.images import compare_file_with_run
    from dyngs.export.splat_files import (
        FOURDGS_SUFFIX,
        FOURDGS_UP,
        choose_write_options,
        read_4dgs_frame,
        scene_part,
        write_4dgs,
    )

    how, line = choose_write_options(opened, FOURDGS_UP, arguments.up, arguments.from_up)
    print_notes((line,))
    part = _part(arguments)
    scene = scene_part(opened.scene, part)
    path = _target(arguments, f"splats{FOURDGS_SUFFIX}")
    splats, notes = write_4dgs(opened, path, times, part, how)
    found = [
        compare_file_with_run(opened, scene, times[i], splats[i], read_4dgs_frame(path, i))
        for i in _shown(len(times))
    ]
    print_image_difference(notes, found)
    return [path]


def _export_tracks(
    arguments: argparse.Namespace, opened: OpenedScene, times: tuple[float, ...] | None
) -> list[Path]:
    from dyngs.export.splat_files import tracks_of, write_tracks

    part = "moving" if arguments.dynamic else "all"
    tracks = tracks_of(opened.scene, times or opened.scene.times or (0.0,), opened.world, part=part)
    count, moments, _ = tracks.positions.shape
    moving = f"{int(tracks.moving.sum()):,} of them moving"
    print_notes(
        (f"{format_count(count, 'Gaussian')}, {moving}, at {format_count(moments, 'time')}",)
    )
    return [write_tracks(_target(arguments, "tracks.npz"), tracks)]


def _export_dyngs(arguments: argparse.Namespace) -> list[Path]:
    """Write the run as a .dyngs file and print the change of its images."""
    from dyngs.api.scene_file import write_scene_file
    from dyngs.compress.measure import SMALLEST_CHANGE

    max_change: float | None = arguments.max_change
    if max_change is not None and not SMALLEST_CHANGE <= max_change <= 64:
        raise DyngsError(
            f"--max-change {max_change:g}: must be from {SMALLEST_CHANGE:g} to 64 (grey levels of "
            "255)"
        )
    out: Path = arguments.out or arguments.run_dir
    if out.suffix == ".dyngs":
        raise DyngsError(
            f"{out}: --format dyngs writes a folder with config.yaml and scene.dyngs; "
            f"use --out {out.with_suffix('')}"
        )
    root = args.data_root(arguments)
    with ProgressBar() as report:
        written = write_scene_file(arguments.run_dir, out, max_change, root, report)
    change = written.precision.change
    if change is None:
        warning = (
            "capture not found: using default quantisation steps, without measuring the change of "
            "images; if the capture was moved, add data.root=FOLDER"
        )
        print_notes((), (warning,))
    else:
        print_notes((f"RMS change of training views: {change:.2f} grey levels of 255",))
    ratio = written.num_bytes_exact / written.num_bytes
    size = f"{written.num_bytes / 1e6:.2f} MB"
    print_notes((f"{size}, {ratio:.1f} times smaller than uncompressed",))
    return [written.path]


def _export_avatar(arguments: argparse.Namespace) -> list[Path]:
    from dyngs.human.avatar.avatar_file import write_avatar
    from dyngs.runs.folder import collect_inputs
    from dyngs.runs.opened import open_run

    path = _target(arguments, "avatar.safetensors")
    run = open_run(arguments.run_dir).in_edit_frame()
    collect_inputs(run).require_output(path)
    return [write_avatar(run.renderable, run.config.model, run.info, path)]


def _export_network(arguments: argparse.Namespace) -> list[Path]:
    from dyngs.api.predict import network_config
    from dyngs.runs.checkpoint import latest_checkpoint
    from dyngs.runs.network_file import SUFFIX, write_network

    run: Path = arguments.run_dir
    out = _target(arguments, f"network{SUFFIX}")
    return [write_network(run, network_config(run), latest_checkpoint(run), out)]


def _export_bodies(arguments: argparse.Namespace) -> list[Path]:
    """Write a moving scene with its rigid bodies as animated nodes."""
    from dyngs.export.images import compare_file_with_run
    from dyngs.export.splat_files import choose_write_options, write_rigid_bodies
    from dyngs.io.formats.formats import format_by_name, read_splats

    out = _target(arguments, "bodies.glb")
    opened = _open(arguments)
    time = (_times(arguments) or (0.0,))[0]
    how, line = choose_write_options(
        opened, format_by_name("glb").up, arguments.up, arguments.from_up
    )
    how = replace(how, classic=arguments.classic)
    written = write_rigid_bodies(opened, out, time, how)
    print_notes((line,))
    found = compare_file_with_run(
        opened, opened.scene, time, written.splat, read_splats(written.path)
    )
    print_image_difference(written.notes, [found])
    return [written.path]


def _export_person(arguments: argparse.Namespace) -> list[Path]:
    """Write a person as a skinned mesh."""
    from dyngs.export.rigged.people import AnimationInfo, write_mesh
    from dyngs.runs.opened import FRAME_RATE

    out = _target(arguments, "mesh.glb")
    motion = arguments.motion
    opened = _moved(arguments, _open(arguments)).in_edit_frame()
    played = None if motion is None else AnimationInfo(motion.stem, opened.fps or FRAME_RATE)
    print_notes(write_mesh(opened, out, played))
    return [out]


def _has_surface(arguments: argparse.Namespace) -> bool:
    """Return whether the mesh is extracted from depth; False for people, whose body is a mesh."""
    from dyngs.config.io import load_resolved

    source: Path = arguments.run_dir
    if source.is_file() and not args.is_avatar_file(source):
        raise DyngsError(
            f"{source}: a mesh needs the depth of training views; give a run instead of a file"
        )
    from dyngs.models.kind import HasBody, capability

    return source.is_dir() and capability(load_resolved(source).model, HasBody) is None


def _export_surface(arguments: argparse.Namespace) -> list[Path]:
    """Write the mesh of a scene, one file per time."""
    from dyngs.export.surface_file import surface_write_options, write_surface
    from dyngs.gaussians.surface import count_holes
    from dyngs.models.renderable import SurfaceOptions

    out: Path = arguments.out or arguments.run_dir / ("mesh" if arguments.times else "mesh.ply")
    if arguments.times and out.suffix:
        raise DyngsError(
            f"{out}: --times writes a folder; use --out {out.with_suffix('')}, or --time for one "
            "file"
        )
    opened = _open(arguments)
    options = SurfaceOptions(arguments.level, arguments.cells)
    how, line = surface_write_options(
        opened, ".ply" if arguments.times else out.suffix, arguments.up, arguments.from_up
    )
    print_notes((line,))
    written: list[Path] = []
    for i, time in enumerate(_times(arguments) or (0.0,)):
        path = out / f"mesh_{i:04d}.ply" if arguments.times else out
        surface = write_surface(opened, path, time=time, options=options, how=how)
        holes = count_holes(surface)
        closed = "closed" if holes == 0 else f"{format_count(holes, 'hole')}"
        faces = format_count(len(surface.faces), "triangle")
        print_notes((f"{faces}, {len(surface.vertices):,} vertices, {closed}",))
        written.append(path)
    return written


def _export_page(arguments: argparse.Namespace) -> list[Path]:
    """Write a self-contained web page, or a folder whose page streams the scene."""
    from dyngs.export.html.page import write_page

    most = arguments.max_gaussians_drawn
    if most is not None and not arguments.folder:
        raise DyngsError("--max-gaussians-drawn requires --folder")
    if arguments.folder:
        out = arguments.out or arguments.run_dir / "scene"
        if out.suffix.lower() == ".html":
            raise DyngsError(f"{out}: --folder writes a folder; use --out {out.with_suffix('')}")
        where = f"serve it with `python -m http.server -d {quote_path(out)}`"
    else:
        out = _target(arguments, "scene.html")
        where = "open it in any browser with WebGL 2"
    opened = _moved(arguments, _open(arguments))
    opened = opened if arguments.from_up is None else replace(opened, stated_up=arguments.from_up)
    written = write_page(
        opened,
        out,
        folder=arguments.folder,
        most=most,
        title=arguments.title,
        time=arguments.time or 0.0,
        view=arguments.view,
    )
    print_notes((*written.notes, where))
    return [written.path]


def _export_cameras(arguments: argparse.Namespace) -> list[Path]:
    """Write the cameras of a run as a transforms.json, refined if training refined them."""
    from dyngs.data.capture import all_views
    from dyngs.evaluate.report import load_camera_corrections
    from dyngs.export.cameras import NAME, write_cameras
    from dyngs.runs.opened import open_run

    source: Path = arguments.run_dir
    out: Path = arguments.out or source / "cameras"
    path = out if out.suffix.lower() == ".json" else out / NAME
    run = open_run(source, data_root=args.data_root(arguments))
    capture = run.capture
    if path.resolve().parent == capture.root.resolve():
        raise DyngsError(f"{path}: would override the cameras of the capture; use another folder")
    found = load_camera_corrections(source, run, capture.splits["train"])
    if found is None and run.config.camera.refine == "always":
        raise DyngsError(
            f"{source}: refined cameras are stored in checkpoints, but there are none; train again"
        )
    splits: dict[Split, Sequence[View]] = {
        name: views for name, views in capture.splits.items() if name != "pose"
    }
    line = "exporting the cameras of the capture, because camera.refine was not used"
    if found is not None:
        line = "exporting refined training cameras; other cameras keep the poses of the capture"
        for name, views in splits.items():
            splits[name] = [found.correct_view(view) for view in views]
    print_notes((line,))
    written = write_cameras(path, capture, splits, run.world)
    count = format_count(len(all_views(capture.splits)), "camera")
    root = quote_path(path.parent)
    print_notes((f"{count}; `data.root={root} data.follow_links=true` trains with them",))
    return [written]
