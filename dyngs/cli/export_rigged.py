"""``dyngs export --format mesh`` and ``--joints``: a person with the skeleton, for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyngs.cli.arguments import data_root, is_avatar_file, print_notes
from dyngs.errors import DyngsError


def export_rigged(arguments: argparse.Namespace, kind: str) -> int:
    """Write a person as a skinned mesh, or as Gaussians with joints, and print where the file is and how large.

    Raises:
        DyngsError: an option that does not go with it, no run of a person there, or a file that cannot be written.
    """
    from dyngs.export.rigged.mesh_file import Played, write_mesh
    from dyngs.export.rigged.splat_files import write_rigged_splats
    from dyngs.runs.opened import FRAME_RATE, open_scene

    wanted = "--joints" if arguments.joints else "--format mesh"
    if arguments.joints and kind not in ("ply", "glb"):
        raise DyngsError(f"--joints goes with --format ply and glb, not with {kind}")
    suffix = ".ply" if kind == "ply" else ".glb"
    source: Path = arguments.run_dir
    is_file = is_avatar_file(source)
    if is_file and arguments.out is None:
        raise DyngsError(f"{source}: where to? Give --out FILE{suffix}")
    name = f"{'rigged' if arguments.joints else 'mesh'}{suffix}"
    out: Path = arguments.out or source / name
    if out.is_dir() or out.suffix.lower() != suffix:
        raise DyngsError(
            f"{out}: {wanted} writes one file; give --out {out / name if out.is_dir() else out.stem + suffix}"
        )
    if suffix == ".ply" and arguments.motion is not None:
        raise DyngsError("--motion does not go with --joints in a .ply, which has the rest pose; give --out FILE.glb")
    opened, played = open_scene(source, data_root=data_root(arguments)), None
    if arguments.motion is not None:
        opened = opened.in_motion(arguments.motion)
        played = Played(arguments.motion.stem, opened.fps or FRAME_RATE)
    written = (write_rigged_splats if arguments.joints else write_mesh)(opened, out, played)
    print_notes(written.notes)
    print(f"written: {written.path} ({written.path.stat().st_size / 1e6:.1f} MB)")
    return 0
