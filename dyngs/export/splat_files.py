"""Export of Gaussians: single times, sequences, streamed .sog levels, .4dgs, .glb bodies and
tracks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from dyngs.core.conventions import SH_C0
from dyngs.core.errors import DyngsError, format_count
from dyngs.core.gaussians import Gaussians
from dyngs.deform.bodies.field import BodyField, find_body_field
from dyngs.deform.scene import field_scene_of
from dyngs.export.classic import CLASSIC, fit_classic
from dyngs.gaussians.colour.network import bake_harmonics
from dyngs.gaussians.levels import MERGED, build_levels
from dyngs.gaussians.rendering import splat_options
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.static_scene import StaticScene
from dyngs.io.formats.formats import (
    SOG_INDEX,
    Format,
    WrittenFile,
    format_by_name,
    format_for_path,
    limit_to_format,
    rotate_file,
    transform_file,
    write_splats,
)
from dyngs.io.formats.gltf import EXTENSION, add_gaussians
from dyngs.io.formats.similarity import (
    AXES,
    IDENTITY,
    Similarity,
    nearest_axis,
    parse_axis,
    rotation_between,
)
from dyngs.io.formats.sog import sog_parts
from dyngs.io.formats.splat_file import (
    SplatFile,
    from_linear,
    header_comments,
    make_renderable,
    offset_notes,
    require_writable,
    unit_rotations,
    with_sh_degree,
)
from dyngs.io.gltf import GlbDocument
from dyngs.io.outputs import atomic_folder, require_new_folder
from dyngs.io.write import atomic_file
from dyngs.ops.quaternions import align_quat_signs, rotation_matrices, unit_quats
from dyngs.runs.folder import collect_inputs
from dyngs.runs.opened import OpenedScene, wrap_scene

PER_LEAF = MERGED**7  # Gaussians of a leaf at level 0
PER_FILE = MERGED**9  # Most Gaussians of a file
COARSEST = 4  # Coarsest level, with 64 Gaussians per leaf


def write_sog_levels(folder: Path, splat: SplatFile) -> tuple[int, ...]:
    """Write a new folder of streamed .sog levels of detail. Return the number of Gaussians per
    level, finest first.

    Args:
        splat: content that fits the .sog format, see ``fitted``.

    Raises:
        DyngsError: the folder is not empty or cannot be written.
    """
    require_new_folder(folder)
    levels = build_levels(splat.gaussians).levels[: COARSEST + 1]
    counts = tuple(len(level) for level in levels)
    names: list[str] = []
    with atomic_folder(folder) as started:
        first = []  # index of the first file of each level
        for number, level in enumerate(levels):
            first.append(len(names))
            for i, start in enumerate(range(0, len(level), PER_FILE)):
                own = started / f"{number}_{i}"
                own.mkdir()
                names.append(f"{own.name}/meta.json")
                part = replace(splat, gaussians=_rows(level, start, PER_FILE))
                for name, data in sog_parts(part):
                    (own / name).write_bytes(data)
        nodes = []
        for start in range(0, counts[0], PER_LEAF):
            lods = {}
            for level, count in enumerate(counts):
                own = start // MERGED**level
                lods[str(level)] = {
                    "file": first[level] + own // PER_FILE,
                    "offset": own % PER_FILE,
                    "count": min(PER_LEAF // MERGED**level, count - own),
                }
            nodes.append({"bound": _box(_rows(levels[0], start, PER_LEAF)), "lods": lods})
        while len(nodes) > 1:  # group four nodes into one
            groups = [nodes[i : i + MERGED] for i in range(0, len(nodes), MERGED)]
            nodes = []
            for group in groups:
                low = np.min([node["bound"]["min"] for node in group], axis=0)
                high = np.max([node["bound"]["max"] for node in group], axis=0)
                bound = {"min": low.tolist(), "max": high.tolist()}
                nodes.append({"bound": bound, "children": group})
        index = {
            "version": 1,
            "asset": {"generator": "dyngs"},
            "count": sum(counts),
            "counts": counts,
            "lodLevels": len(levels),
            "filenames": names,
            "tree": nodes[0],
        }
        (started / SOG_INDEX).write_text(json.dumps(index, separators=(",", ":")), encoding="utf-8")
    return counts


def _rows(gaussians: Gaussians, start: int, count: int) -> Gaussians:
    return gaussians.select(torch.arange(start, min(start + count, len(gaussians)), device="cpu"))


def _box(gaussians: Gaussians) -> dict[str, list[float]]:
    """Return the bounding box of Gaussians at three standard deviations."""
    axes = rotation_matrices(gaussians.quats) * gaussians.scales[:, None]
    reach = 3.0 * axes.square().sum(2).sqrt()
    low = (gaussians.means - reach).amin(0)
    high = (gaussians.means + reach).amax(0)
    return {"min": low.tolist(), "max": high.tolist()}


Part = Literal["all", "moving", "static"]


@dataclass(frozen=True)
class WriteOptions:
    """Options for writing Gaussians to a file."""

    # unit quaternion wxyz from the axes of the capture (or of an edited run) to those of the file
    turn: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    up: str | None = None  # up axis in the file, such as "-y"; None if unknown
    # SH degree in the file; None keeps it, up to the limit of the format
    sh_degree: int | None = None
    edit: Similarity = IDENTITY  # applied after ``turn``, and stored to be undone
    # fit for viewers without antialiasing; None: formats that cannot store the render mode
    classic: bool | None = None


DEFAULT_WRITE_OPTIONS = WriteOptions()


def choose_write_options(
    opened: OpenedScene,
    target: str,
    up: str | None = None,
    from_up: str | None = None,
    sh_degree: int | None = None,
) -> tuple[WriteOptions, str]:
    """Return write options for a scene, and a note about the up axis of the file.

    Args:
        target: up axis that viewers of the format expect.
        up: requested up axis. "keep" keeps the axes of the scene.
        from_up: up axis of the scene. None finds it with ``find_up_direction``.

    Raises:
        DyngsError: invalid axis.
    """
    edited = opened.edited
    frame = "capture" if edited is None else "edited run"
    if up == "keep" or (edited is not None and edited.fixed and up is None):
        own = None if edited is None else edited.up
        known = "" if own is None else f", {own} up"
        return WriteOptions(
            up=own, sh_degree=sh_degree
        ), f"axes of the {frame.removesuffix('ed run')} are kept{known}"
    found = find_up_direction(opened) if from_up is None else (parse_axis(from_up), "--from-up")
    if found is None:
        line = "unknown up direction, axes of the capture are kept; set it with --from-up=AXIS"
        return WriteOptions(sh_degree=sh_degree), line
    direction, who = found
    wanted = target if up is None else up
    here = next((name for name, axis in AXES.items() if axis == direction), "a slanted direction")
    turned = f"rotated from {here} in the {frame}"
    turned = f"axes of the {frame} kept" if here == wanted else turned
    how = WriteOptions(rotation_between(direction, parse_axis(wanted)), wanted, sh_degree)
    return how, f"up is {wanted} in the file ({turned}; source: {who})"


def find_up_direction(opened: OpenedScene) -> tuple[tuple[float, ...], str] | None:
    """Return the up direction (3,) in the axes of ``splats_at``, and its source. None if unknown.

    A direction within 30 degrees of an axis is snapped to the axis.
    """
    if opened.up is None:
        return None
    found, who = opened.up
    if opened.edited is not None:
        found = opened.frame.rotation @ found
    direction = tuple(found.tolist())
    name = nearest_axis(direction)
    return (direction if name is None else AXES[name]), who


def write_run_splats(
    opened: OpenedScene,
    path: Path,
    time: float = 0.0,
    part: Part = "all",
    how: WriteOptions = DEFAULT_WRITE_OPTIONS,
) -> WrittenFile:
    """Write a run at a time in [0, 1] as a file of Gaussians. The suffix selects the format.

    Gaussians that do not exist at that time are left out. The 3D filter is fused, and colours of a
    network become spherical harmonics. The header stores the render mode, and the time of a moving
    scene.

    Raises:
        DyngsError: an empty part, or an unknown suffix.
    """
    collect_inputs(opened).require_output(path)
    splat = splats_at(opened, scene_part(opened.scene, part), time, how)
    exists = splat.gaussians.opacities > 0
    splat = replace(splat, gaussians=splat.gaussians.select(exists))
    splat, notes = _for_viewers(opened, splat, format_for_path(path), how)
    written = write_splats(path, splat, sh_degree=how.sh_degree)
    return replace(written, notes=(*notes, *written.notes))


def _for_viewers(
    opened: OpenedScene, splat: SplatFile, own: Format, how: WriteOptions
) -> tuple[SplatFile, tuple[str, ...]]:
    """Return the version of a scene for the viewers of a format, and a note if it was fitted.

    Raises DyngsError: ``how.classic``, but no capture can be read.
    """
    wanted = not own.stores_render_mode if how.classic is None else how.classic
    degree = own.max_degree if how.sh_degree is None else how.sh_degree
    loses_colours = degree == 0 and splat.gaussians.sh_degree > 0
    if not wanted or not (loses_colours or splat_options(splat) != CLASSIC):
        return splat, ()
    if opened.cameras is None:
        if how.classic:
            raise DyngsError(
                "--classic fits to training cameras, which were not found; give a run, and "
                "data.root=FOLDER if its capture was moved"
            )
        return splat, ()
    frame = splat.frame.after(opened.file_unit)
    near = opened.scene.options.near * frame.scale
    fitted, note = fit_classic(splat, frame.cameras(opened.cameras), near, degree)
    return fitted, (note,)


def save(
    scene: GaussianScene | Gaussians,
    path: Path | str,
    *,
    time: float | None = None,
    sh_degree: int | None = None,
) -> Path:
    """Write a scene in memory as a file of Gaussians, in its own axes. Returns the path.

    ``dyngs.export`` writes runs, in more formats and with the axes that viewers expect.

    Example:

        import dyngs

        scene = dyngs.load("runs/lego")
        opaque = scene.gaussians.opacities > 0.1
        dyngs.save(scene.select(opaque), "opaque.ply")

    Args:
        scene: a scene, or Gaussians.
        path: the suffix selects the format.
        time: in [0, 1], of a moving scene.
        sh_degree: highest degree in the file; None: that of the scene.

    Raises:
        DyngsError: an unknown suffix, no time of a moving scene, or a file that cannot be written.
    """
    if isinstance(scene, Gaussians):
        scene = StaticScene(gaussians=scene)
    if time is None and not scene.is_static:
        raise DyngsError(f"{path}: the scene moves; give time=T, or use dyngs.export for all times")
    how = WriteOptions(sh_degree=sh_degree)
    return write_run_splats(wrap_scene(scene), Path(path), time or 0.0, how=how).path


def write_run_sequence(
    opened: OpenedScene,
    folder: Path,
    times: Sequence[float],
    part: Part = "all",
    how: WriteOptions = DEFAULT_WRITE_OPTIONS,
    suffix: str = ".ply",
) -> list[WrittenFile]:
    """Write a sequence ``frame_0000.ply`` etc., one file per time in [0, 1].

    Files of an earlier sequence of the same length are replaced.

    Raises:
        DyngsError: an empty part, other such files in the folder, or files that cannot be written.
    """
    digits = max(4, len(str(len(times) - 1)))
    names = [f"frame_{i:0{digits}d}{suffix}" for i in range(len(times))]
    inputs = collect_inputs(opened)
    for path in (folder, *(folder / name for name in names)):
        inputs.require_output(path)
    others = sorted(file.name for file in folder.glob(f"[!.]*{suffix}") if file.name not in names)
    if others:
        raise DyngsError(
            f"{folder}: contains other {suffix} files ({others[0]}); use an empty folder"
        )
    return [
        write_run_splats(opened, folder / name, time, part, how)
        for name, time in zip(names, times, strict=True)
    ]


def write_run_levels(
    opened: OpenedScene, folder: Path, time: float, part: Part, how: WriteOptions
) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Write a run at a time as a new folder of .sog levels. Return the Gaussians per level, and
    notes.

    Raises:
        DyngsError: an empty part, or a folder that is not empty.
    """
    collect_inputs(opened).require_output(folder)
    own = format_by_name("sog")
    splat = splats_at(opened, scene_part(opened.scene, part), time, how)
    splat, fitted = _for_viewers(opened, splat, own, how)
    whole, notes = limit_to_format(folder, own, splat, how.sh_degree)
    return write_sog_levels(folder, whole), (*fitted, *notes)


def scene_part(scene: GaussianScene, part: Part) -> GaussianScene:
    """Return the moving or static part of a scene. Raises DyngsError if it is empty."""
    if part == "all":
        return scene
    found = scene.part(part)
    if not len(found):
        what = "the whole scene moves" if part == "static" else "nothing moves in this run"
        raise DyngsError(f"{what}: no {'static' if part == 'static' else 'dynamic'} part")
    return found


def splats_at(
    opened: OpenedScene,
    scene: GaussianScene,
    time: float,
    how: WriteOptions = DEFAULT_WRITE_OPTIONS,
) -> SplatFile:
    """Return the content of a file of Gaussians for a scene at one time, in the requested axes.

    An edited run is in its own frame, which the file stores to be undone.
    """
    with torch.no_grad():
        moment = scene.time_step(time)
    gaussians = moment.gaussians
    shader = scene.shader(moment)
    comments = [f"step: {opened.step}"]
    if not scene.is_static:
        comments.append(f"dyngs time {time!r}")
    if shader is not None:
        baked = bake_harmonics(gaussians, shader)
        gaussians = baked.gaussians
        comments.append(f"colours: harmonics fitted to a network, rms error {baked.error:.4f}")
    x, y, z = opened.info.world_offset
    gaussians = opened.file_unit.gaussians(gaussians.detach())
    options = scene.options
    splat = SplatFile(gaussians, options.mode, options.eps2d, (x, y, z), tuple(comments))
    if opened.edited is not None:
        splat = transform_file(
            splat, opened.frame.after(opened.file_unit.inverse()), opened.edited.up
        )
    splat = rotate_file(splat, how.turn, how.up)
    return splat if how.edit == IDENTITY else transform_file(splat, how.edit, how.up)


@dataclass(frozen=True)
class Tracks:
    """Positions of N Gaussians, or of the moving ones, at T times. Fields are the arrays of the
    file."""

    # (N, T, 3) in the coordinates of the capture or of an edited run; float32, or float64 if the
    # scene has a world offset or was edited
    positions: np.ndarray
    times: np.ndarray  # (T,) float64 in [0, 1]
    moving: np.ndarray  # (N,) bool
    # (N,) int64 index of each Gaussian in the model, and its row in an exported .ply if all exist
    ids: np.ndarray
    visible: np.ndarray  # (N, T) bool: Gaussians with a lifetime exist at some times only


def tracks_of(
    scene: GaussianScene, times: Sequence[float], frame: Similarity = IDENTITY, *, part: str = "all"
) -> Tracks:
    """Return the tracks of a scene, transformed by ``frame``.

    Args:
        part: "moving" returns moving Gaussians only.

    Raises:
        DyngsError: no Gaussian moves, for the moving part.
    """
    moves = torch.zeros(len(scene), dtype=torch.bool, device="cpu")
    moves[scene.rows] = not scene.is_static
    if part == "moving":
        scene_part(scene, "moving")
    ids = torch.arange(len(scene), device="cpu")
    ids = ids[moves] if part == "moving" else ids
    kind = np.float32 if frame == IDENTITY else np.float64
    whole = scene.without_masks()
    positions = np.empty((len(ids), len(times), 3), kind)
    visible = np.empty((len(ids), len(times)), bool)
    for k, time in enumerate(times):
        now = whole.at(time)
        positions[:, k] = now.means[ids].numpy()
        visible[:, k] = (now.opacities[ids] > scene.options.alpha_min).numpy()
    if frame != IDENTITY:
        positions = frame.points(positions)
    return Tracks(positions, np.array(times, np.float64), moves[ids].numpy(), ids.numpy(), visible)


def write_tracks(path: Path, tracks: Tracks) -> Path:
    """Write tracks as uncompressed .npz with one array per field of ``Tracks``. Return the path.

    Raises:
        DyngsError: non-finite positions, or the file cannot be written.
    """
    if not np.isfinite(tracks.positions).all():
        raise DyngsError(f"{path}: not written, positions are not finite")
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **asdict(tracks))
    return path


FOURDGS_SUFFIX = ".4dgs"
FOURDGS_UP = "-y"
FOURDGS_FPS = 30.0


def write_4dgs(
    opened: OpenedScene,
    path: Path,
    times: Sequence[float],
    part: Part = "all",
    how: WriteOptions = DEFAULT_WRITE_OPTIONS,
) -> tuple[tuple[SplatFile, ...], tuple[str, ...]]:
    """Write a run at T >= 1 times in [0, 1] as one .4dgs file, each time shown for 1/30 s.

    Returns:
        the intended content at each time, and notes about properties the format cannot store.

    Raises:
        DyngsError: a missing package, an empty part, or the file cannot be written.
    """
    collect_inputs(opened).require_output(path)
    model, delta, files = _fourdgs(path)
    scene = scene_part(opened.scene, part)
    splats = tuple(splats_at(opened, scene, time, how) for time in times)
    duration = len(times) / FOURDGS_FPS
    samples = []
    for i, splat in enumerate(splats):
        gaussians = splat.gaussians
        n = len(gaussians)
        rgba = torch.cat([gaussians.base_rgb.clamp(0, 1), gaussians.opacities[:, None]], dim=1)
        states = model.GaussianSet(
            positions=gaussians.means.numpy(),
            scales=gaussians.scales.numpy(),
            rotations=unit_rotations(gaussians.quats).numpy()[:, [1, 2, 3, 0]],
            colors=rgba.numpy(),
            motions=np.zeros((n, 3), np.float32),
            mu_t=np.full(n, i / FOURDGS_FPS, np.float32),
            # standard deviation in time: Gaussians never fade
            sigma_t=np.full(n, 1e4 * duration, np.float32),
            win_lo=np.zeros(n, np.float32),
            win_hi=np.full(n, duration, np.float32),
        )
        samples.append(delta.Sample(t0=i / FOURDGS_FPS, ids=np.arange(n), gaussians=states))
    options = delta.KeyframeDeltaOptions(keyframe_every=8)
    data = files.write_sequence(samples, duration, kd=options, profile="fine", library="dyngs")
    with atomic_file(path) as temporary:
        temporary.write_bytes(data)
    notes = (
        f"{format_count(len(times), 'time')}, each shown for 1/{FOURDGS_FPS:.0f} s",
        *offset_notes(splats[0], "4dgs cannot state it"),
    )
    if any(bool(splat.gaussians.sh[:, 1:].any()) for splat in splats):
        notes += ("SH degree reduced to 0: .4dgs stores no more for moving Gaussians",)
    return splats, notes


def read_4dgs_frame(path: Path, index: int) -> SplatFile:
    """Read the Gaussians of a .4dgs written by dyngs at time index ``index``.

    Raises:
        DyngsError: a missing package, or non-finite values.
    """
    _, _, files = _fourdgs(path)
    found = files.render_at(files.decode_streamed(path.read_bytes()), (index + 0.5) / FOURDGS_FPS)
    sh = ((found["rgb"] - 0.5) / SH_C0)[:, None]
    quats = found["rotations"][:, [3, 0, 1, 2]]
    gaussians = from_linear(found["centers"], quats, found["scales"], found["opacity"], sh)
    return make_renderable(SplatFile(gaussians), path, "error")


def _fourdgs(path: Path) -> tuple[Any, Any, Any]:
    names = ("model", "keyframe_delta_writer", "keyframe_delta_file")
    try:
        model, delta, files = (import_module(f"fourdgs.{name}") for name in names)
    except ImportError:
        raise DyngsError(
            f"{path}: .4dgs needs the package fourdgs; run pip install 'dyngs[4dgs]'"
        ) from None
    return model, delta, files


@torch.no_grad()
def write_rigid_bodies(
    opened: OpenedScene, path: Path, time: float, how: WriteOptions
) -> WrittenFile:
    """Write a run at a time in [0, 1] as .glb: an animated node per rigid body, and one for the
    rest.

    Raises:
        DyngsError: no rigid body in this run, or the file cannot be written.
    """
    collect_inputs(opened).require_output(path)
    scene = field_scene_of(opened.scene)
    field = None if scene is None else find_body_field(scene.field)
    if scene is None or field is None:
        raise DyngsError("--bodies: no rotating body in this run; remove it, or use --times A:B:N")
    scene = scene.without_masks()  # labels refer to all rows
    splat = splats_at(opened, scene, time, how)
    splat, fitted = _for_viewers(opened, splat, format_by_name("glb"), how)
    require_writable(path, splat.gaussians)
    gaussians = splat.gaussians.replace(quats=unit_rotations(splat.gaussians.quats))
    gaussians = with_sh_degree(gaussians, min(gaussians.sh_degree, 3))
    labels = torch.full((len(scene),), -1, device=scene.moving.device)
    labels[scene.moving] = field.rest.labels
    # Twice as many poses as training times, since rotations are interpolated.
    moments = np.linspace(0.0, 1.0, 2 * max(len(scene.times) - 1, 1) + 1)
    places, turns = _poses(field, [time, *moments.tolist()], splat.frame)
    document = GlbDocument()
    nodes = []
    meshes = []
    channels = []
    for body in range(-1, len(field.rest.centers)):
        own = gaussians.picked(torch.nonzero(labels == body)[:, 0])
        if not len(own):
            continue
        name = "rest" if body < 0 else f"body {body}"
        node: dict[str, object] = {"name": name, "mesh": len(meshes)}
        if body >= 0:
            place = places[0, body]
            own = own.replace(means=(own.means.double() - torch.from_numpy(place)).float())
            node["translation"] = place.tolist()
            turned = Rotation.from_quat(turns[1:, body]) * Rotation.from_quat(turns[0, body]).inv()
            channels.append((len(nodes), "translation", places[1:, body]))
            channels.append((len(nodes), "rotation", align_quat_signs(turned.as_quat())))
        meshes.append({"name": name, "primitives": [add_gaussians(document, own)]})
        nodes.append(node)
    document.add_animation("motion", moments * opened.seconds, channels)
    document.json["asset"]["extras"] = header_comments(splat)
    document.json |= {
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
    }
    with atomic_file(path) as temporary:
        document.write(temporary)
    notes = (
        *fitted,
        f"bodies: {len(channels) // 2}, animated for {opened.seconds:.1f} s, with the colours of "
        f"time {time:g}",
        f"other motion and shadows are frozen at time {time:g}; export a sequence to keep them",
        *offset_notes(splat, "the file states it"),
    )
    return WrittenFile(path, splat, notes)


def _poses(
    field: BodyField, times: Sequence[float], frame: Similarity
) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (T, B, 3) and rotations (T, B, 4) xyzw of B bodies at T times, in the axes of
    the file."""
    axes = Rotation.from_quat(np.asarray(frame.turn)[[1, 2, 3, 0]])
    places, quats = zip(*(field.poses(float(time)) for time in times), strict=True)
    unit = unit_quats(torch.stack(quats)).double().numpy()[..., [1, 2, 3, 0]]
    turned = (axes * Rotation.from_quat(unit.reshape(-1, 4))).as_quat()
    return frame.points(torch.stack(places).double().numpy()), turned.reshape(unit.shape)
