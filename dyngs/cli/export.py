"""``dyngs export``: a run as a file for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli.render import is_avatar, moment, say
from dyngs.errors import DyngsError

if TYPE_CHECKING:
    from dyngs.export.run_to_ply import Part
    from dyngs.runs.checkpoint import LoadedRun

_EPILOG = """\
examples:
  dyngs export runs/bench                                         runs/bench/splats.ply
  dyngs export runs/dance --time 0.5 --out middle.ply             one moment
  dyngs export runs/dance --times 0:1:30 --out frames             frame_0000.ply ... for players of sequences
  dyngs export runs/dance --static --out stage.ply                only what never moves
  dyngs export runs/ann --motion walk.npz --out walk              a person (model.kind=human), one file per frame
  dyngs export runs/ann --format avatar --out ann.safetensors     the person in one file, which these commands take, too
  dyngs export runs/dance --format tracks --dynamic               where everything that moves is, as .npz
  dyngs export runs/dance --format compact --out small            the run in little space, for eval, render and export
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``export`` to the commands."""
    parser = commands.add_parser(
        "export",
        help="write a run as files for other programs",
        description="Write the Gaussians of a run as the standard 3DGS .ply, which viewers and editors read, or the "
        "tracks of their centres, or a person as one file.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run_dir", type=Path, metavar="RUN", help="folder that `dyngs train` wrote, or an avatar file")
    parser.add_argument("--format", choices=("ply", "tracks", "compact", "avatar"), default="ply")
    parser.add_argument(
        "--out", type=Path, metavar="PATH", help="a file, or the folder of a sequence (default: splats... in RUN)"
    )
    when = parser.add_mutually_exclusive_group()
    when.add_argument("--time", type=moment, metavar="T", help="this moment, from 0 to 1 (default 0)")
    when.add_argument("--times", metavar="A:B:N", help="N moments from A to B (tracks: default those of training)")
    parser.add_argument(
        "--motion", type=Path, metavar="FILE", help="what the person of a run does: AMASS .npz, .bvh, .glb or .gltf"
    )
    parser.add_argument(
        "--max-change",
        type=float,
        metavar="X",
        help="compact: how much pictures may change, grey levels of 255 (default: 0.025 dB on training views)",
    )
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--static", action="store_true", help="only the Gaussians that never move")
    part.add_argument("--dynamic", action="store_true", help="only the Gaussians that move")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the files and say how large they are."""
    from dyngs.export.avatar import read_avatar
    from dyngs.runs.checkpoint import load_run

    is_file = is_avatar(arguments.run_dir)
    if is_file and (arguments.out is None or arguments.format in ("compact", "avatar")):
        raise DyngsError(f"{arguments.run_dir}: an avatar file is exported as --format ply or tracks, with --out PATH")
    if arguments.format == "avatar":
        return _export_avatar(arguments)
    if arguments.format == "compact":
        return _export_compact(arguments)
    if arguments.max_change is not None:
        raise DyngsError("--max-change goes with --format compact")
    if arguments.format == "tracks" and arguments.static:
        raise DyngsError("--static goes with --format ply; what never moves has no tracks")
    times = _times(arguments)
    loaded = (read_avatar if is_file else load_run)(arguments.run_dir)
    if arguments.motion is not None:
        from dyngs.view.animation import with_motion

        loaded = with_motion(loaded, arguments.motion).run
        times = loaded.scene.times if times is None else times
    if loaded.scene.is_still and times is not None:
        say(("nothing moves in this run: it is the same at all times",))
    write = _export_tracks if arguments.format == "tracks" else _export_ply
    files = write(arguments, loaded, times)
    size = sum(path.stat().st_size for path in files) / 1e6
    where = files[0] if len(files) == 1 else f"{len(files)} files, {files[0]} to {files[-1].name}"
    print(f"written: {where} ({size:.1f} MB)")
    return 0


def _export_compact(arguments: argparse.Namespace) -> int:
    """Write the run in little space, and say what that does to it."""
    from dyngs.storage.run import SMALLEST_CHANGE, write_compact

    options = ("time", "times", "motion", "static", "dynamic")
    given = [name for name in options if getattr(arguments, name) not in (None, False)]
    if given:
        raise DyngsError(f"--{given[0]} does not go with --format compact, which stores all of a run")
    max_change: float | None = arguments.max_change
    if max_change is not None and not SMALLEST_CHANGE <= max_change <= 64:
        raise DyngsError(f"--max-change {max_change:g}: give {SMALLEST_CHANGE:g} to 64 grey levels of 255")
    out: Path = arguments.out or arguments.run_dir
    if out.suffix == ".dyngs":
        raise DyngsError(
            f"{out}: a compact run is a folder (config.yaml and scene.dyngs); give --out {out.with_suffix('')}"
        )
    written = write_compact(arguments.run_dir, out, max_change)
    change = written.precision.change
    if change is None:
        say((), ("the run's capture cannot be read: fixed steps were taken, what they do to pictures is not measured",))
    else:
        say((f"pictures change by {change:.2f} grey levels of 255 (root mean square of some training views)",))
    ratio = written.num_bytes_exact / written.num_bytes
    print(f"written: {written.path} ({written.num_bytes / 1e6:.2f} MB, {ratio:.1f} times smaller than before)")
    return 0


def _export_avatar(arguments: argparse.Namespace) -> int:
    """Write the person of a run as one file."""
    from dyngs.export.avatar import write_avatar
    from dyngs.runs.checkpoint import load_run

    given = ("motion", "time", "times", "static", "dynamic")
    unfit = [f"--{name}" for name in given if getattr(arguments, name) not in (None, False)]
    if unfit:
        raise DyngsError(f"{unfit[0]} does not go with --format avatar, which holds what is the same in all poses")
    path = write_avatar(load_run(arguments.run_dir), arguments.out or arguments.run_dir / "avatar.safetensors")
    print(f"written: {path} ({path.stat().st_size / 1e6:.1f} MB)")
    return 0


def _times(arguments: argparse.Namespace) -> tuple[float, ...] | None:
    """The times asked for, within [0, 1]; None where none is."""
    from dyngs.evaluate.temporal import clamped_times
    from dyngs.view.camera_paths import parse_times

    if arguments.times is None and arguments.time is None:
        return None
    inside, warnings = clamped_times((arguments.time,) if arguments.times is None else parse_times(arguments.times))
    say((), warnings)
    return inside


def _export_ply(arguments: argparse.Namespace, loaded: LoadedRun, times: tuple[float, ...] | None) -> list[Path]:
    """The files written: a sequence where things move at several times, one file otherwise."""
    from dyngs.export.run_to_ply import write_run_ply, write_run_ply_sequence

    if loaded.scene.colour is not None:
        say(("the run's colours are a network; the file holds harmonics of degree 3 that are fitted to it",))
    part: Part = "still" if arguments.static else "moving" if arguments.dynamic else "all"
    stem = "splats" + ("_static" if arguments.static else "_dynamic" if arguments.dynamic else "")
    out: Path | None = arguments.out
    is_sequence = arguments.times is not None or (arguments.motion is not None and arguments.time is None)
    if not is_sequence or arguments.static:
        if out is not None and out.suffix.lower() != ".ply" and (out.is_dir() or is_sequence):
            out = out / f"{stem}.ply"
        if times is None and not arguments.static and not loaded.scene.is_still:
            say(("this is time 0 of a moving scene; --time T gives another, --times 0:1:30 a sequence",))
        time = 0.0 if times is None else times[0]
        return [write_run_ply(loaded, out or arguments.run_dir / f"{stem}.ply", time, part)]
    if out is not None and out.suffix.lower() == ".ply":
        raise DyngsError(f"{out}: a sequence is a folder of files; give --out DIR, or --time for one file")
    return write_run_ply_sequence(loaded, out or arguments.run_dir / stem, times or (), part)


def _export_tracks(arguments: argparse.Namespace, loaded: LoadedRun, times: tuple[float, ...] | None) -> list[Path]:
    from dyngs.export.tracks import tracks_of, write_tracks

    part = "moving" if arguments.dynamic else "all"
    tracks = tracks_of(loaded.scene, times or loaded.scene.times or (0.0,), loaded.info.world_offset, part=part)
    count, moments, _ = tracks.positions.shape
    say((f"{count:,} Gaussians, {int(tracks.moving.sum()):,} of them moving, at {moments} times",))
    return [write_tracks(arguments.out or arguments.run_dir / "tracks.npz", tracks)]
