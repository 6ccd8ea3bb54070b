"""COLMAP for structure from motion: options, image layout, and calls of pycolmap."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dyngs.capture.sfm.photos import Photo
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError
from dyngs.io.write import write_text

if TYPE_CHECKING:
    import pycolmap

LENS = "SIMPLE_RADIAL"
"""COLMAP's name of the lens model that is fitted."""
LONGEST_SIDE, MAX_FEATURES = 1600, 8192
"""Longest side in px and number of features for SIFT; poses refer to the full size."""
SEED = 0


@dataclass(frozen=True)
class SfmOptions:
    """Options of pose estimation.

    Attributes:
        matching: auto = all pairs of up to 60 photos or 24 frames, beyond that neighbours by name
            (some distant ones, too) and similar images; sequential = without similar images;
            exhaustive = all pairs.
        num_frames: images taken from a video at most, None = 100; for several videos the number of
            time steps, None = ``MOST_STEPS``, fewer for many cameras.
        masks: folder of masks named after the photos; white = used. None without.
        num_threads: for features and matches, 0 = all cores; mapping uses one, for reproducible
            results.
        follow_links: photos and videos may be links out of their folder.
    """

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    num_frames: int | None = None
    masks: Path | None = None
    num_threads: int = 0
    follow_links: bool = False


@dataclass(frozen=True)
class SfmTask:
    """Images laid out for COLMAP.

    Attributes:
        database: COLMAP's; made where it is missing.
        images: folder of upright images, ``names`` in order; ``photos``: the same ones, with their
            tags.
        is_video: they are frames of a video.
        masks: folder of masks ``NAME.png``, white = keep; None without.
    """

    database: Path
    images: Path
    names: Sequence[str]
    photos: Sequence[Photo]
    options: SfmOptions
    report: ProgressCallback = ignore_progress
    is_video: bool = False
    masks: Path | None = None

    @property
    def side(self) -> int:
        """Longest side of an image, in pixels."""
        return max((max(photo.header.size) for photo in self.photos), default=0)

    @property
    def has_one_lens(self) -> bool:
        """Whether all images share a lens: of a video, or of the same size, camera model and focal
        length (EXIF)."""
        kinds = {(p.header.upright_size, p.header.camera, p.header.focal_px) for p in self.photos}
        return self.is_video or len(kinds) == 1


def feature_options(num_threads: int, side: int, count: int) -> pycolmap.FeatureExtractionOptions:
    """Return COLMAP's options for up to ``count`` SIFT features in images of up to ``side`` px, on
    the CPU."""
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.num_threads = num_threads or -1
    extraction.max_image_size = side
    extraction.sift.max_num_features = count
    return extraction


def matching_options(
    num_threads: int,
) -> tuple[pycolmap.FeatureMatchingOptions, pycolmap.TwoViewGeometryOptions]:
    """Return COLMAP's options for matching on the CPU, and for verification."""
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    verification = pycolmap.TwoViewGeometryOptions()
    matching.use_gpu = False
    matching.num_threads = num_threads or -1
    verification.ransac.random_seed = SEED
    return matching, verification


def match_listed(
    database: Path, names: Sequence[str], pairs: Sequence[tuple[int, int]], num_threads: int
) -> None:
    """Match and verify pairs of images, given by index into the names; earlier matches are
    kept."""
    import pycolmap

    matching, verification = matching_options(num_threads)
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = database.with_name("pairs.txt")
    write_text(Path(pairing.match_list_path), "".join(f"{names[i]} {names[j]}\n" for i, j in pairs))
    pycolmap.match_image_pairs(database, matching, pairing, verification, pycolmap.Device.cpu)


def incremental_options(num_threads: int, seed: int = SEED) -> pycolmap.IncrementalPipelineOptions:
    """Return COLMAP's options for incremental mapping on the CPU."""
    import pycolmap

    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads = num_threads or -1
    mapping.random_seed = mapping.mapper.random_seed = mapping.triangulation.random_seed = seed
    mapping.ba_use_gpu = False
    return mapping


class ColmapError(DyngsError):
    """COLMAP failed."""


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Silence COLMAP's log, seed it, and turn its errors in the block into ColmapError."""
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(SEED)
    try:
        yield
    except (RuntimeError, ValueError) as error:
        lines = str(error).strip().splitlines()
        raise ColmapError(
            f"structure from motion failed: {lines[-1] if lines else error}"
        ) from error
    finally:
        pycolmap.logging.minloglevel = level
