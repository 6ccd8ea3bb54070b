"""Camera poses for a folder of photos or a video, by pycolmap's structure from motion on the CPU."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from dyngs.conventions import ReportProgress, report_nothing
from dyngs.data.frame_seconds import write_seconds
from dyngs.data.pictures.images import read_header
from dyngs.data.pictures.video import frame_seconds, read_frames
from dyngs.data.prepare.sfm_progress import sequential_pairs, watched
from dyngs.errors import DyngsError, reading
from dyngs.files.containment import MAX_MEGAPIXELS, check_size, inside, pictures_up_to, staying_within
from dyngs.files.picture_errors import any_text, picture_error
from dyngs.files.temporary import temporary_folder_beside
from dyngs.files.write import write_image
from dyngs.files.wrong_place import PHOTO_SUFFIXES

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True)
class SfmOptions:
    """Options of pose estimation.

    Attributes:
        camera_model: COLMAP's name of the lens model to fit.
        single_camera: one camera took all pictures, so they share its lens; None = yes for a video, and for photos that
            agree in size, camera model and focal length (EXIF); else every photo has a lens of its own.
        matching: which pairs are compared; auto = all pairs up to 60 photos, neighbours by name beyond and for videos.
        overlap: neighbours on either side in sequential matching.
        max_features: SIFT features per picture.
        longest_side: pictures are shrunk to this, in pixels, for finding features (poses refer to the full size).
        num_frames: pictures to take from a video, evenly spaced, the sharpest around each place.
        seed: of everything random.
        num_threads: 0 = all cores; other numbers may give other last digits.
        follow_links: photos may be links that lead out of their folder.
        max_megapixels: larger pictures and videos are refused.
    """

    camera_model: Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"] = (
        "SIMPLE_RADIAL"
    )
    single_camera: bool | None = None
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    overlap: int = 10
    max_features: int = 8192
    longest_side: int = 1600
    num_frames: int = 100
    seed: int = 0
    num_threads: int = 0
    follow_links: bool = False
    max_megapixels: float = MAX_MEGAPIXELS


@dataclass(frozen=True)
class SfmResult:
    """Result of pose estimation.

    Attributes:
        root: the capture folder in COLMAP's layout, to be trained on.
        num_images: pictures given.
        num_registered: pictures with a pose.
        unregistered: names of the others.
        num_points: sparse points.
        mean_error_px: mean reprojection error.
    """

    root: Path
    num_images: int
    num_registered: int
    unregistered: tuple[str, ...]
    num_points: int
    mean_error_px: float

    def summary(self) -> str:
        """The result as one or two lines of text."""
        line = (
            f"{self.num_registered} of {self.num_images} pictures registered, {self.num_points} points, "
            f"mean error {self.mean_error_px:.2f} px: {self.root}"
        )
        if not self.unregistered:
            return line
        shown = ", ".join(self.unregistered[:5]) + (", ..." if len(self.unregistered) > 5 else "")
        return f"{line}\nno pose for {shown}"


def estimate_poses(
    source: Path, out: Path, options: SfmOptions = SfmOptions(), report: ReportProgress = report_nothing
) -> SfmResult:
    """Estimate poses of the pictures in ``source`` and write a COLMAP capture (``out/images``, ``out/sparse/0``).

    All work is done in a folder beside ``out`` which is renamed at the end, so ``out`` is whole or absent. SIFT
    features, matches, incremental mapping; of several models the one with most pictures is kept.

    Args:
        source: a folder of photos (subfolders included) or a video file.
        out: a folder that does not exist, or is empty.
        options: lens model, matching, effort.
        report: is told of frames read from a video, of pictures with features, of pairs matched, of poses found.

    Raises:
        DyngsError: too few pictures, an ``out`` in use, or nothing could be registered, with advice.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DyngsError(f"{out} exists already; name a new folder for the poses")
    if not source.exists():
        raise DyngsError(f"no such folder of photos or video: {source}")
    work = temporary_folder_beside(out)
    try:
        with staying_within(source, options.follow_links or source.is_file()), pictures_up_to(options.max_megapixels):
            result = _posed_in(work, source, options, _To(out, report))
        work.chmod(0o755)
        if out.exists():
            out.rmdir()
        os.replace(work, out)
        return result
    except OSError as error:
        raise DyngsError(f"cannot write {out}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(work, ignore_errors=True)


@dataclass(frozen=True)
class _To:
    """Where the capture will be, and who is told how far it is."""

    out: Path
    report: ReportProgress


def _posed_in(work: Path, source: Path, options: SfmOptions, to: _To) -> SfmResult:
    """Write the capture for ``to.out`` in the folder ``work`` and return the result."""
    images, is_video = work / "images", source.is_file()
    names = _extract_frames(source, images, options, to.report) if is_video else _gather_photos(source, images, to.out)
    if len(names) < 3:
        raise DyngsError(f"{source} has {len(names)} pictures; structure from motion needs at least 3, better 30")
    return _run_colmap(work, names, is_video, options, to)


def _run_colmap(work: Path, names: list[str], is_video: bool, options: SfmOptions, to: _To) -> SfmResult:
    """Extract features, match and map in ``work``; write ``work/sparse/0`` and return the result."""
    import pycolmap

    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(options.seed)
    try:
        database, models = work / "database.db", work / "models"
        models.mkdir()
        with watched(database, "keypoints", len(names), to.report):
            _find_features(database, work / "images", names, is_video, options)
        sequential = _is_sequential(len(names), is_video, options)
        every = len(names) * (len(names) - 1) // 2
        pairs = min(every, sequential_pairs(len(names), options.overlap)) if sequential else every
        with watched(database, "two_view_geometries", pairs, to.report):
            _match(database, sequential, options)
        found = _map(database, work / "images", models, _mapping_options(options), _PosesFound(len(names), to.report))
    except (RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()
        raise DyngsError(f"structure from motion failed: {reason[-1] if reason else error}") from error
    finally:
        pycolmap.logging.minloglevel = level
    best = max(found.values(), key=lambda model: model.num_reg_images(), default=None)
    if best is None or best.num_reg_images() < 2:
        raise DyngsError(
            f"no poses could be found for {len(names)} pictures: take sharper ones that overlap by two thirds, move "
            "the camera sideways rather than only turning it, avoid bare or moving surfaces, or try matching=exhaustive"
        )
    sparse = work / "sparse" / "0"
    sparse.mkdir(parents=True)
    best.write(sparse)
    registered = {image.name for image in best.images.values() if image.has_pose}
    shutil.rmtree(models)
    database.unlink()
    missing = tuple(name for name in names if name not in registered)
    points, error_px = best.num_points3D(), float(best.compute_mean_reprojection_error())
    return SfmResult(to.out, len(names), len(registered), missing, points, error_px)


def _find_features(database: Path, images: Path, names: list[str], is_video: bool, options: SfmOptions) -> None:
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.num_threads = options.num_threads or -1
    extraction.max_image_size = options.longest_side
    extraction.sift.max_num_features = options.max_features
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = options.camera_model
    single = options.single_camera
    if single is None:
        single = is_video or _same_camera([images / name for name in names])
    mode = pycolmap.CameraMode.SINGLE if single else pycolmap.CameraMode.AUTO
    pycolmap.extract_features(
        database, images, names, camera_mode=mode, reader_options=reader, extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )  # fmt: skip


class _PosesFound:
    """Callback of incremental mapping: a picture has got its pose."""

    def __init__(self, total: int, report: ReportProgress) -> None:
        self._total, self._report, self._done = total, report, 0

    def __call__(self) -> None:
        self._done = min(self._done + 1, self._total)
        self._report("poses, pictures", self._done, self._total)


def _map(
    database: Path, images: Path, models: Path, options: pycolmap.IncrementalPipelineOptions, found: _PosesFound
) -> dict[int, pycolmap.Reconstruction]:
    """Return the models of incremental mapping; ``found`` is called for each picture that gets a pose."""
    import pycolmap

    found()  # the second one of the first pair is told by COLMAP
    return pycolmap.incremental_mapping(
        database, images, models, options, initial_image_pair_callback=found, next_image_callback=found
    )


def _is_sequential(num_images: int, is_video: bool, options: SfmOptions) -> bool:
    """Whether only neighbours by name are compared."""
    return options.matching == "sequential" or (options.matching == "auto" and (is_video or num_images > 60))


def _match(database: Path, sequential: bool, options: SfmOptions) -> None:
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.num_threads = options.num_threads or -1
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    if sequential:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = options.overlap
        pairing.num_threads = options.num_threads or -1
        pycolmap.match_sequential(database, matching, pairing, verification, device=pycolmap.Device.cpu)
    else:
        pycolmap.match_exhaustive(
            database, matching, verification_options=verification, device=pycolmap.Device.cpu
        )  # fmt: skip


def _mapping_options(options: SfmOptions) -> pycolmap.IncrementalPipelineOptions:
    import pycolmap

    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads = options.num_threads or -1
    mapping.random_seed = options.seed
    mapping.mapper.random_seed = options.seed
    mapping.triangulation.random_seed = options.seed
    mapping.min_model_size = 3
    mapping.mapper.init_min_num_inliers = 50
    mapping.ba_use_gpu = False
    return mapping


def _gather_photos(source: Path, images: Path, out: Path) -> list[str]:
    """Copy (hard-link where possible) all photos below ``source``; return their names below ``images``, sorted."""
    result = out.resolve()
    names = []
    for photo in photos_below(source):
        if result in photo.resolve().parents:
            continue
        header = read_header(inside(photo))
        check_size(photo, header.width, header.height, header.channels)
        name = photo.relative_to(source)
        target = images / name
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(photo.resolve(), target)
        except OSError:
            shutil.copyfile(photo, target)
        names.append(name.as_posix())
    return names


def photos_below(folder: Path) -> list[Path]:
    """Return all photos below the folder, sorted; hidden files and folders are left out."""
    return sorted(
        path for path in folder.rglob("*")
        if path.suffix.lower() in PHOTO_SUFFIXES and path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )  # fmt: skip


def _extract_frames(video: Path, images: Path, options: SfmOptions, report: ReportProgress) -> list[str]:
    """Pictures of a video: of ``num_frames`` equal windows the sharpest picture each; their names, in order.

    Two passes, so that only one picture is held in memory: the first one measures. Their seconds are written, too.
    """
    sharpness = np.array([_sharpness(rgb) for rgb in read_frames(video)])
    windows = np.array_split(np.arange(len(sharpness)), min(options.num_frames, max(len(sharpness), 1)))
    chosen = {int(w[sharpness[w].argmax()]) for w in windows if len(w)}
    names = []
    for index, rgb in enumerate(read_frames(video)):
        if index in chosen:
            names.append(f"frame_{index:05d}.png")
            write_image(images / names[-1], rgb)
            report("frames of the video", len(names), len(chosen))
    seconds = frame_seconds(video, len(sharpness))
    write_seconds(images.parent, {name: seconds[index] for name, index in zip(names, sorted(chosen), strict=True)})
    return names


def _same_camera(photos: list[Path]) -> bool:
    """Whether all photos have the same size, and the same camera and focal length in their EXIF tags."""
    import OpenImageIO as oiio

    kinds = set()
    for photo in photos:
        with reading(photo, "remove or replace it"):
            picture = oiio.ImageInput.open(str(photo))
            if picture is None:
                raise DyngsError(f"cannot read the picture {photo.name}: {picture_error(oiio)}; remove or replace it")
            spec = picture.spec()
            model = any_text(partial(spec.get_string_attribute, "Model"))
            kinds.add((spec.width, spec.height, model, spec.get_float_attribute("Exif:FocalLength")))
            picture.close()
    return len(kinds) == 1


def _sharpness(rgb: np.ndarray) -> float:
    """Variance of the Laplacian of the brightness: higher is sharper."""
    grey = rgb[..., 1].astype(np.float32)
    laplacian = (
        4 * grey[1:-1, 1:-1] - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:]
    )  # fmt: skip
    return float(laplacian.var()) if laplacian.size else 0.0
