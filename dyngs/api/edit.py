"""Edit a run or a file of Gaussians (clean, crop, merge, coordinate frame) and write the result."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.compress.clean import clean_file, clean_run, restore_final_trainer
from dyngs.config import Config
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError, format_count, log_info
from dyngs.export.edit.crop import Region, gaussians_in_region
from dyngs.export.edit.frame import Frame, GeoFrame, gps_frame
from dyngs.export.edit.merge import merge_scenes
from dyngs.export.images import compare_file_with_run, compare_file_with_source
from dyngs.export.splat_files import (
    FOURDGS_SUFFIX,
    FOURDGS_UP,
    WriteOptions,
    find_up_direction,
    read_4dgs_frame,
    splats_at,
    write_4dgs,
)
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.formats.formats import (
    all_suffixes,
    find_format,
    format_for_path,
    format_to_read,
    read_splats,
    rotate_file,
    transform_file,
    undo_transforms,
    write_splats,
)
from dyngs.io.formats.similarity import IDENTITY, Similarity, parse_axis
from dyngs.io.formats.splat_file import SplatFile
from dyngs.io.outputs import atomic_folder
from dyngs.models.checkpoint import Checkpoint
from dyngs.ops.device import deterministic, select_device
from dyngs.ops.native import kernel_threads, num_cores
from dyngs.runs.capture_record import RECORD_NAME
from dyngs.runs.checkpoint import (
    SCENE_FILE,
    has_only_scene_file,
    latest_checkpoint,
    save_checkpoint,
    seconds_at,
)
from dyngs.runs.folder import (
    LOG_NAME,
    RunFrame,
    collect_inputs,
    require_empty,
    write_config,
    write_frame,
)
from dyngs.runs.opened import OpenedScene, open_scene, scene_from_file

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Edits:
    """Edits in the order in which they are applied; the defaults change nothing.

    Attributes:
        max_loss: largest PSNR loss by cleaning, dB; None: no cleaning.
        region: region to keep, or to remove if ``outside``.
        merge: files or runs to add.
        frame, geo: new coordinate frame.
        gps: whether ``geo`` is estimated from the GPS positions of the photos.
        undo: whether to restore the original coordinate frame.
        time: time in [0, 1] at which a moving scene is written.
        threads: number of threads for cleaning; 0: one per core.
    """

    max_loss: float | None = None
    region: Region | None = None
    outside: bool = False
    merge: tuple[Path, ...] = ()
    frame: Frame = field(default_factory=Frame)
    geo: GeoFrame | None = None
    gps: bool = False
    undo: bool = False
    time: float | None = None
    threads: int = 0

    @property
    def has_frame(self) -> bool:
        """Whether the coordinate frame changes."""
        return self.geo is not None or self.frame != Frame()


@dataclass(frozen=True)
class EditedFile:
    """Written file or run, with the PSNR between renderings of file and scene, and format notes."""

    path: Path
    redrawn: float | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class EditSource:
    """Scene to edit, with the contents and the default up axis of its file, if it is a file.

    ``rows``: (N,) indices of the remaining Gaussians of a run; None: all.
    """

    opened: OpenedScene
    splat: SplatFile | None = None
    usual: str | None = None
    rows: torch.Tensor | None = None

    @property
    def fixed(self) -> bool:
        """Whether the axes are fixed, as by control points."""
        if self.splat is not None:
            return self.splat.up != self.usual
        return self.opened.edited is not None and self.opened.edited.fixed

    def kept(self, rows: torch.Tensor) -> EditSource:
        """Return the Gaussians where ``rows`` (N,) is true."""
        scene: GaussianScene = self.opened.scene
        before = torch.arange(len(scene), device="cpu") if self.rows is None else self.rows
        return replace(
            self,
            opened=self.opened.with_scene(scene.select(rows.to(scene.device))),
            rows=before[rows.cpu()],
        )

    def at(self, time: float) -> SplatFile:
        """Return the Gaussians of one time, in the axes of the source."""
        if self.splat is not None:
            return replace(self.splat, gaussians=self.opened.scene.gaussians)
        return splats_at(self.opened, self.opened.scene, time)


def edit_scene(
    source: Path,
    out: Path,
    edits: Edits,
    reads: Sequence[Path] = (),
    data_root: Path | None = None,
    tell: Tell = log_info,
) -> EditedFile:
    """Edit a run or a file of Gaussians, and write the result to ``out``.

    The suffix of ``out`` selects the format; without a suffix a run is written. ``reads`` are
    additional input files. Raises DyngsError for impossible edits, before anything is written.
    """
    moves = out.name.lower().endswith(FOURDGS_SUFFIX)
    if find_format(out) is None and not moves and out.suffix:
        wanted = (
            f"give a name in {all_suffixes()} or {FOURDGS_SUFFIX}, or without a suffix for a run"
        )
        raise DyngsError(f"{out}: edits end in a file of Gaussians or a run; {wanted}")
    collect_inputs(source, *edits.merge, *reads).require_output(out)
    found = _opened(source, data_root)
    for note in found.opened.notes:
        tell(note)
    if edits.gps:
        edits = replace(edits, geo=gps_frame(found.opened))
    if edits.max_loss is not None:
        if found.splat is None:
            found = found.kept(clean_run(source, edits.max_loss, edits.threads, data_root, tell))
        else:
            found = found.kept(clean_file(found.opened.scene.gaussians, tell))
    found = _cropped(found, source, edits, tell)
    if not out.suffix:
        return EditedFile(_written_run(found, source, out, edits, data_root, tell))
    return _written_moving(found, out, edits, tell) if moves else _written(found, out, edits, tell)


def write_part(
    opened: OpenedScene, rows: torch.Tensor, out: Path, time: float | None = None
) -> EditedFile:
    """Write the Gaussians ``rows`` (N,) of a scene, at ``time`` if it moves, with the up axis of
    the format.

    Raises DyngsError: a scene without a file or run, or an output that cannot be written.
    """
    if opened.path is None:
        raise DyngsError("this scene has no file or run of its own yet, so it cannot be edited")
    found = _opened(opened.path, None) if opened.captured is None else EditSource(opened)
    return _written(found.kept(rows), out, Edits(time=time), lambda _: None)


def _opened(source: Path, data_root: Path | None) -> EditSource:
    own = format_to_read(source)
    if own is not None and data_root is None:
        splat = read_splats(source, nonfinite="skip")
        opened = scene_from_file(splat, source)
        info = replace(opened.info, world_offset=splat.file_offset)
        return EditSource(replace(opened, info=info), splat, own.up)
    return EditSource(open_scene(source, data_root=data_root))


def _cropped(found: EditSource, source: Path, edits: Edits, tell: Tell) -> EditSource:
    if edits.region is None:
        return found
    scene: GaussianScene = found.opened.scene
    rows = gaussians_in_region(edits.region, scene, found.opened.world) ^ edits.outside
    count = int(rows.sum())
    if not count:
        points = found.opened.world.points(scene.at(None).means.cpu().numpy())
        low, high = (
            ", ".join(f"{x:.10g}" for x in end.tolist()) for end in (points.min(0), points.max(0))
        )
        raise DyngsError(
            f"{source}: --crop leaves none of {format_count(len(scene), 'Gaussian')}; they lie between {low} and {high}"
        )
    tell(f"crop: {count:,} of {format_count(len(scene), 'Gaussian')} stay")
    return found.kept(rows)


def _written(found: EditSource, out: Path, edits: Edits, tell: Tell) -> EditedFile:
    """Write a file of Gaussians, at one time of what moves."""
    moving = not found.opened.scene.is_static
    if moving and edits.merge:
        raise DyngsError("--merge requires static scenes; make one with `dyngs export --time T`")
    if moving and edits.time is None:
        tell(
            "time 0 of a moving scene is used; choose with --time T, or write all times with "
            f"--out {out.stem}{FOURDGS_SUFFIX}"
        )
    splat = found.at(edits.time or 0.0)
    if edits.merge:
        splat = merge_scenes(splat, _up(found, edits.frame), edits.merge, tell)
    if edits.undo:
        if splat.edited == IDENTITY:
            raise DyngsError(
                "--undo: the coordinate frame of this file was not changed by `dyngs edit`"
            )
        edited = undo_transforms(splat)
        tell("restored the original coordinate frame")
    else:
        how, up = _frame(found, edits, format_for_path(out).up, tell)
        is_new = edits.has_frame
        edited = transform_file(splat, how, up) if is_new else rotate_file(splat, how.turn, up)
    written = write_splats(out, edited)
    return EditedFile(written.path, compare_file_with_source(splat, written), written.notes)


def _written_moving(found: EditSource, out: Path, edits: Edits, tell: Tell) -> EditedFile:
    """Write all training times of a moving scene."""
    scene = found.opened.scene
    if scene.is_static or edits.merge or edits.undo or edits.time is not None:
        raise DyngsError(
            f"{out}: {FOURDGS_SUFFIX} holds a scene that moves, at all times, without --merge, --undo and --time; "
            f"give a name in {all_suffixes()}"
        )
    how, up = _frame(found, edits, FOURDGS_UP, tell)
    writing = (
        WriteOptions(edit=how, up=up) if edits.has_frame else WriteOptions(turn=how.turn, up=up)
    )
    splats, notes = write_4dgs(found.opened, out, scene.times, how=writing)
    redrawn = compare_file_with_run(
        found.opened, scene, scene.times[0], splats[0], read_4dgs_frame(out, 0)
    )
    return EditedFile(out, redrawn, notes)


def _written_run(
    found: EditSource, source: Path, out: Path, edits: Edits, data_root: Path | None, tell: Tell
) -> Path:
    """Write a run as the new folder ``out``, which is drawn, viewed, exported and pruned as any
    other, and keeps all that it has learned."""
    opened = found.opened
    if opened.captured is None or edits.merge or edits.time is not None:
        raise DyngsError(
            f"{out}: a name without a suffix is a run, made of a run, without --merge and --time; "
            f"give a name in {all_suffixes()}"
        )
    frame = opened.edited
    if edits.undo:
        if frame is None:
            raise DyngsError("--undo: the coordinate frame of this run was not changed")
        frame = None
        tell("restored the original coordinate frame")
    elif edits.has_frame:
        how, up = _frame(found, edits, "z", tell)
        offset = (0.0, 0.0, 0.0) if edits.geo is None else edits.geo.offset
        fixed = edits.geo is not None or (found.fixed and edits.frame.up is None)
        frame = RunFrame(how.after(opened.frame), offset, up, fixed)
    config = load_resolved(source, [f"run.dir={out}"], data_root=data_root)
    stored = has_only_scene_file(source)
    if found.rows is not None and stored:
        raise DyngsError(
            f"{source}: holds no checkpoint that a part could be taken of; give --out FILE.ply"
        )
    with atomic_folder(out, require_empty) as folder:
        for name in (LOG_NAME, RECORD_NAME, *([SCENE_FILE] if stored else [])):
            if (source / name).is_file():
                shutil.copyfile(source / name, folder / name)
        if not stored:
            whole = latest_checkpoint(source)
            kept = whole if found.rows is None else _part(config, source, found.rows)
            save_checkpoint(folder, kept, seconds_at(source, whole.info.step))
        write_config(config, folder)
        if frame is not None:
            write_frame(folder, frame)
    return out


def _part(config: Config, run_dir: Path, rows: Tensor) -> Checkpoint:
    """Return the last checkpoint of a run with the Gaussians ``rows`` (N,) only."""
    with (
        kernel_threads(config.run.threads or num_cores()),
        deterministic(select_device(config.run.device), True),
    ):
        trainer = restore_final_trainer(config, run_dir)
        kept = torch.zeros(trainer.num_gaussians, dtype=torch.bool, device=trainer.device)
        kept[rows.to(trainer.device)] = True
        trainer.model.select_gaussians(kept, trainer.done)
        return trainer.checkpoint()


def _up(found: EditSource, frame: Frame) -> tuple[float, ...] | None:
    """Return the up direction (3,) of the source: given or detected; None if there is neither."""
    if isinstance(frame.up, tuple):
        return frame.up
    if frame.up is None:
        known_axis = find_up_direction(found.opened)
        return None if known_axis is None else known_axis[0]
    known = None if found.splat is not None else found.opened.up
    if known is None:
        raise DyngsError(
            "--up auto needs the cameras of a run, and there are none; give the direction, as --up=-y"
        )
    return tuple((found.opened.frame.rotation @ known[0]).tolist())


def _frame(
    found: EditSource, edits: Edits, wanted: str, tell: Tell
) -> tuple[Similarity, str | None]:
    """Return the similarity to the requested frame, and its up axis; ``wanted``: the axis for
    viewers."""
    offset = found.opened.world_offset
    if edits.geo is not None:
        for line in edits.geo.lines:
            tell(line)
        if wanted != "z":
            tell(
                f"axes are those of the control points, with z up; viewers of the format take {wanted} for up"
            )
        x, y, z = offset.tolist()
        return edits.geo.similarity.after(Similarity(shift=(x, y, z))), "z"
    frame = edits.frame
    direction = _up(found, frame)
    if frame.origin is not None:
        x, y, z = (np.array(frame.origin) - offset).tolist()
        frame = replace(frame, origin=(x, y, z))
    if found.fixed and frame.up is None:
        how = frame.similarity(None, ())
        up = found.opened.stated_up
    else:
        how = frame.similarity(direction, parse_axis(wanted))
        up = None if direction is None else wanted
    about = "up direction unknown, the scene is not rotated; set it with --up"
    tell(about if up is None else f"up axis of the output: {up}")
    return how, up
