"""Captures of several videos of fixed cameras that ran at once: offsets between their clocks, one
pose for each camera, frames with seconds.

Offsets are given, zero, or found by sound. Poses are those of one image per camera, the median of
its clip, which shows what is static.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dyngs.capture.sfm.colmap import (
    LENS,
    LONGEST_SIDE,
    MAX_FEATURES,
    SEED,
    SfmOptions,
    feature_options,
    incremental_options,
    matching_options,
    quiet_colmap,
)
from dyngs.capture.sfm.frame_choice import FIXED_CAMERA_LIMIT, camera_displacement, small_brightness
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.data.images.video import (
    VideoInfo,
    colour_messages,
    frame_seconds,
    list_videos,
    open_video_container,
    probe_video,
    read_numbered_frames,
)
from dyngs.data.readers.camera_folders import MIN_CAMERAS_TO_HOLD_OUT
from dyngs.data.readers.colmap import TEST_LIST
from dyngs.data.times import evenly_spaced, write_seconds
from dyngs.io.containment import check_inside, restrict_paths_to
from dyngs.io.fields import first_few, is_number, read_json_object
from dyngs.io.outputs import atomic_folder
from dyngs.io.write import write_image, write_text

if TYPE_CHECKING:
    import pycolmap

VIDEOS_FILE = "videos.json"
MAX_START = 86_400.0  # seconds; later starts of a video are taken for mistakes
MOST_STEPS = 300  # time steps that are taken, those of the usual clips of ten seconds
MOST_IMAGES = 4000  # images of all cameras together
# frames within this fraction of a frame's duration of a time step count as taken at it
SAME_STEP = 0.2
MEDIAN_FRAMES = 15  # frames whose median shows what is static
MEDIAN_BYTES = 400_000_000  # memory that these frames take at most


@dataclass(frozen=True)
class CameraVideo:
    """The video of the camera ``name``; ``seconds`` (F,) at which each frame is shown, the first
    one at 0."""

    name: str
    path: Path
    info: VideoInfo
    seconds: np.ndarray

    @property
    def rate(self) -> float:
        """Frames per second, by the times of the frames."""
        gap = float(np.median(np.diff(self.seconds))) if len(self.seconds) > 1 else 0.0
        return 1 / gap if gap > 0 else self.info.fps or 30.0


def open_video(path: Path) -> CameraVideo:
    """Read size and times of the frames of a video."""
    info = probe_video(path)
    return CameraVideo(path.stem, path, info, np.array(frame_seconds(path, info.num_frames)))


def poses_of_videos(
    source: Path,
    out: Path,
    options: SfmOptions = SfmOptions(),
    report: ProgressCallback = ignore_progress,
) -> str:
    """Make a capture of a folder of videos of fixed cameras that ran at once; return a description
    of the result.

    All work is done in a folder next to ``out`` which is renamed at the end, so ``out`` is complete
    or absent. It is in COLMAP's layout, with ``times.json``, and ready to be trained on. Raises
    DyngsError: a camera that moves, poses or offsets that cannot be found, with what to do; an
    ``out`` in use.

    Args:
        source: a folder with two videos or more, and ``videos.json`` if something is known.
        out: a folder that does not exist, or is empty.
    """
    with atomic_folder(out) as work, restrict_paths_to(source, options.follow_links):
        videos = [open_video(check_inside(path)) for path in list_videos(source)]
        names = [video.name for video in videos]
        if len(videos) < 2:
            raise DyngsError(
                f"{source}: holds {len(videos)} videos, but two or more are needed; give a "
                "single video as the file itself"
            )
        starts, test = read_video_settings(source, names)
        lines = colour_messages(video.info for video in videos)
        images, line = _static_images(source, videos, report)
        lines.append(line)
        if starts is None:
            starts, line = estimate_starts_by_sound(videos)
        else:
            line = f"camera offsets as given: {_described(starts)}"
        lines.append(line)
        model, line = _posed(work, images, options, report)
        lines.append(line)
        posed = _posed_images(model)
        videos = [video for video in videos if video.name in posed]
        names = [video.name for video in videos]
        earliest = min(starts[name] for name in names)
        starts = {name: starts[name] - earliest for name in names}
        frames, line = frames_at_steps(source, videos, starts, options.num_frames)
        lines.append(line)
        seconds = _write_images(work, videos, frames, report)
        write_seconds(work, seconds)
        _write_model(work, model, posed, names, list(seconds))
        if test is None:
            test = names[: len(names) >= MIN_CAMERAS_TO_HOLD_OUT]
        test = [name for name in names if name in test]
        if test:
            listed = [f"{name}\n" for name in seconds if name.partition("/")[0] in test]
            write_text(work / "sparse" / "0" / TEST_LIST, "".join(listed))
            lines.append(f"held out for testing: {first_few(test)}")
        rounded = {name: round(start, 6) for name, start in starts.items()}
        known = {"starts": rounded, "test": test}
        write_text(work / VIDEOS_FILE, json.dumps(known, indent=1) + "\n")
    return "\n".join((*lines, f"written: {out}"))


# What is known beforehand


def read_video_settings(
    folder: Path, names: Sequence[str]
) -> tuple[dict[str, float] | None, list[str] | None]:
    """Return when the videos begin, by camera, in one clock, and the cameras for testing; None: not
    known.

    By ``videos.json``: ``{"starts": {"cam00": 0, "cam01": 1.25}, "test": ["cam00"]}``; all keys are
    optional. ``"starts": 0`` says that all videos begin at once. Raises DyngsError: a camera that
    is not there or missing, or something that is no number.
    """
    path = folder / VIDEOS_FILE
    fields: dict[str, Any] = read_json_object(path) if path.is_file() else {}
    starts = fields.get("starts")
    test = fields.get("test")
    wrong = f"it may contain 'starts' and 'test', a list of some of the cameras {first_few(names)}"
    with wrap_read_errors(path, wrong):
        if fields.keys() - {"starts", "test"} or not set(test or ()) < set(names):
            raise ValueError("an unknown key or camera, or no camera left to train on")
    if starts is None:
        return None, test
    if starts == 0:
        starts = dict.fromkeys(names, 0.0)
    fits = isinstance(starts, dict) and starts.keys() == set(names)
    if not fits or not all(is_number(x) and abs(x) <= MAX_START for x in starts.values()):
        raise DyngsError(
            f"{path}: give the start of each video in seconds, for {first_few(names)}, got "
            f"{starts!r:.80}"
        )
    return {name: float(second) for name, second in starts.items()}, test


def _described(starts: Mapping[str, float]) -> str:
    return first_few([f"{name} +{start:.3f} s" for name, start in starts.items()])


# Offsets by sound

SOUND_RATE = 100.0  # values of a signal per second
MAX_SOUND = 900.0  # seconds; sound after this is not compared
SAMPLE_RATE = 8000
BANDS_HZ = (60, 150, 300, 500, 800, 1200, 1800, 2600, 3900)
WINDOW = 256  # samples of a spectrum: 32 ms
# fraction of the shorter signal that must lie within the other one at every shift that is tried
MIN_OVERLAP = 0.4
MIN_SAMPLES = 8  # and the least number of samples
MIN_PEAK = 0.15  # lowest correlation of two signals that count as alike
RIVAL = 0.8  # a peak is clear if no other one is higher than this times itself
# standard deviations of the other correlations that a peak must have where no third recording can
# confirm it: that of unrelated signals has fewer
CERTAIN_DEVIATIONS = 6.0
PEAK_WIDTH = 2  # shifts within so many samples of a peak belong to it
WHOLE = 0.2  # offsets so near to whole frames, in frames, are taken as whole
MAX_RATE = 60.0  # frames per second


def estimate_starts_by_sound(videos: Sequence[CameraVideo]) -> tuple[dict[str, float], str]:
    """Estimate the seconds at which videos begin, by name, the earliest at 0, from their sound;
    with a line on how sure they are.

    All recordings are shifted against the one that is most like the others. Half of the other pairs
    must have the same shifts. Raises DyngsError: the sound does not tell; says what to give.
    """
    sounds: list[np.ndarray] = []
    for video in videos:
        sound = loudness_onsets(video.path)
        if sound is None:
            raise _unknown(videos, f"{video.name} has no sound")
        sounds.append(sound)
    count = len(videos)
    # of the second signal of a pair against the first one
    samples, peaks, deviations = np.zeros((3, count, count))
    for i, j in combinations(range(count), 2):
        samples[i, j], peaks[i, j], deviations[i, j] = estimate_shift(sounds[i], sounds[j])
    samples -= samples.T
    peaks += peaks.T
    middle = int(peaks.sum(axis=0).argmax())
    shifts = samples[middle]
    pairs = np.triu_indices(count, 1)
    agree = (peaks > 0) & (np.abs(samples - (shifts - shifts[:, None])) <= 1)
    agreeing = int(agree[pairs].sum())
    total = count * (count - 1) // 2
    confirmed = 2 * (agreeing - (count - 1)) >= total - (count - 1)
    if count == 2:
        confirmed = deviations[0, 1] >= CERTAIN_DEVIATIONS
    if agree[middle].sum() < count - 1 or not confirmed:
        raise _unknown(videos, f"the sound of only {agreeing} of {total} pairs agrees")
    rate = min(max(video.rate for video in videos), MAX_RATE)
    frames = (shifts - shifts.min()) / SOUND_RATE * rate
    if np.abs(frames - np.round(frames)).max() <= WHOLE:
        frames = np.round(frames)
    starts = dict(zip([video.name for video in videos], (frames / rate).tolist(), strict=True))
    sure = f"{agreeing} of {total} pairs agree"
    return starts, f"camera offsets estimated from sound ({sure}): {_described(starts)}"


def _unknown(videos: Sequence[CameraVideo], reason: str) -> DyngsError:
    return DyngsError(
        f"the offsets between the videos are unknown: {reason}; give the start of each video in "
        "seconds in "
        f'{VIDEOS_FILE} next to them, {{"starts": {{"{videos[0].name}": 0, "{videos[1].name}": '
        f'0.5, ..}}}}, or {{"starts": 0}} if all start at the same time'
    )


def estimate_shift(a: np.ndarray, b: np.ndarray) -> tuple[int, float, float]:
    """Return the shift of the highest correlation of two signals (T, B) of one rate, in samples:
    time of ``b`` plus the shift is time of ``a``; that correlation, 0 if it is low or not alone;
    and its height in standard deviations of the others.

    Each column is taken relative to its mean. At every shift the energy of what overlaps is the
    norm.
    """
    from scipy.signal import correlate, correlation_lags, find_peaks

    def over_shifts(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.asarray(correlate(x, y, method="fft"))

    a, b = (x - x.mean(axis=0) for x in (a.astype(np.float64), b.astype(np.float64)))
    shifts = correlation_lags(len(a), len(b))
    ones_a = np.ones(len(a))
    ones_b = np.ones(len(b))
    energy_a = (a * a).sum(axis=1)
    energy_b = (b * b).sum(axis=1)
    products = np.sum([over_shifts(x, y) for x, y in zip(a.T, b.T, strict=True)], axis=0)
    energies = over_shifts(energy_a, ones_b) * over_shifts(ones_a, energy_b)
    overlap = over_shifts(ones_a, ones_b)
    least = max(MIN_OVERLAP * min(len(a), len(b)), MIN_SAMPLES)
    is_known = (overlap > least - 0.5) & (energies > 1e-6 * energy_a.sum() * energy_b.sum())
    values = np.where(is_known, products / np.sqrt(np.maximum(energies, 1e-12)), 0.0)
    top = int(np.argmax(values))
    others = np.abs(shifts - shifts[top]) > PEAK_WIDTH
    tops, _ = find_peaks(values)
    rival = values[tops[others[tops]]].max(initial=0.0)
    is_clear = values[top] >= MIN_PEAK and rival <= RIVAL * values[top]
    deviation = np.sqrt(np.mean(values[others & is_known] ** 2))
    return int(shifts[top]), float(values[top] * is_clear), float(values[top] / deviation)


def loudness_onsets(path: Path) -> np.ndarray | None:
    """Return (T, B) rises of loudness in B bands, ``SOUND_RATE`` per second from the first image
    on; None without sound.

    Silence counts as no sound.
    """
    samples = _samples(path)
    if samples is None or len(samples) < 10 * WINDOW or np.abs(samples).max() < 1e-4:
        return None
    from scipy.signal import spectrogram

    overlap = WINDOW - int(SAMPLE_RATE / SOUND_RATE)
    frequency, _, power = spectrogram(samples, SAMPLE_RATE, "hann", WINDOW, overlap)
    loudness = np.add.reduceat(power.T, np.searchsorted(frequency, BANDS_HZ), axis=1)[:, :-1]
    floor = 1e-3 * loudness.mean(axis=0) + 1e-15
    rises = np.diff(np.log(loudness + floor), axis=0)
    return np.clip(rises, 0.0, 5.0)


def _samples(path: Path) -> np.ndarray | None:
    """Return mono samples from the first image on, in [-1, 1]; None without a track of sound."""
    import av
    from av.error import FFmpegError

    blocks: list[np.ndarray] = []
    lead = 0.0
    with (
        wrap_read_errors(path, "it must be a video; copy or convert it again"),
        open_video_container(path) as container,
    ):
        if not container.streams.audio:
            return None
        image = container.streams.video[0]
        first_image = float((image.start_time or 0) * (image.time_base or 0))
        resampler = av.AudioResampler("flt", "mono", SAMPLE_RATE)
        try:
            for frame in container.decode(container.streams.audio[0]):
                if not blocks:
                    lead = (frame.time or 0.0) - first_image
                blocks += [part.to_ndarray().reshape(-1) for part in resampler.resample(frame)]
                if (frame.time or 0.0) > MAX_SOUND:
                    break
        except FFmpegError:
            pass  # damaged sound: what was read up to there is compared
    if not blocks:
        return None
    samples = np.nan_to_num(np.concatenate(blocks).astype(np.float32))
    missing = round(float(np.clip(lead, -MAX_SOUND, MAX_SOUND)) * SAMPLE_RATE)
    return np.pad(samples, (missing, 0)) if missing >= 0 else samples[-missing:]


# Poses of the cameras

# random seeds of mapping: repeated patterns lead some astray, and then fewer points are seen
MAPPING_SEEDS = (0, 1, 2)
LARGEST_ERROR = 2.0  # observations with a larger reprojection error, in px, are left out in the end
# points that only two cameras see are left out where each camera sees so many others
ENOUGH_TRACKS = 60
# mean reprojection error in px above which cameras of one size are also tried with a lens each,
# which are kept if they lower the error to this fraction, or give more cameras a pose
LONE_LENSES = 1.0
LESS_ERROR = 0.7


def _static_images(
    source: Path, videos: Sequence[CameraVideo], report: ProgressCallback
) -> tuple[dict[str, np.ndarray], str]:
    """Return the median image (H, W, 3) uint8 of each camera, without moving things, and a message
    that no camera moves."""
    images: dict[str, np.ndarray] = {}
    displaced: dict[str, float] = {}
    for video in videos:
        frame_bytes = max(video.info.width * video.info.height * 3, 1)
        most = max(MEDIAN_BYTES // frame_bytes, 3)
        wanted = evenly_spaced(len(video.seconds), min(MEDIAN_FRAMES, most))
        frames = np.stack([rgb for _, rgb in read_numbered_frames(video.path, wanted)])
        displaced[video.name] = camera_displacement(
            np.stack([small_brightness(rgb) for rgb in frames])
        )
        frames.sort(axis=0)
        images[video.name] = frames[len(frames) // 2]
        report("static images, cameras", len(images), len(videos))
    moving = [
        f"{name} (by {x:.1%} of its width)"
        for name, x in displaced.items()
        if x > FIXED_CAMERA_LIMIT
    ]
    if moving:
        raise DyngsError(
            f"{source}: cameras of several videos must be fixed, but these move: "
            f"{first_few(moving)}; remove them, stabilise shaky videos, or train on one moving "
            "camera's video alone"
        )
    return images, (
        f"{len(videos)} cameras are fixed (image displacement at most "
        f"{max(displaced.values()):.2%} of the width, {FIXED_CAMERA_LIMIT:.1%} allowed)"
    )


def _posed(
    work: Path, images: Mapping[str, np.ndarray], options: SfmOptions, report: ProgressCallback
) -> tuple[pycolmap.Reconstruction, str]:
    """Return the model of an image ``CAMERA.png`` for each camera, and a line on it.

    SIFT features, all pairs matched, incremental mapping from several random seeds; of the models,
    that with most cameras, then with most observations. Cameras of one size share a lens unless
    that fits badly.
    """
    folder = work / "colmap"
    for name, rgb in images.items():
        size = f"{rgb.shape[1]}x{rgb.shape[0]}"  # a folder has one lens where lenses are shared
        write_image(folder / "images" / size / f"{name}.png", rgb)
    lens = "one lens per image size"
    with quiet_colmap():
        model = _mapped(folder, True, options.num_threads)
        report("poses of the cameras, attempts", 1, 2)
        if (
            model is None
            or model.num_reg_images() < len(images)
            or model.compute_mean_reprojection_error() > LONE_LENSES
        ):
            lone = _mapped(folder, False, options.num_threads)
            if lone is not None and (model is None or _is_better(lone, model)):
                model, lens = lone, "one lens per camera"
        report("poses of the cameras, attempts", 2, 2)
    shutil.rmtree(folder)
    names = set() if model is None else _posed_images(model).keys()
    if model is None or len(names) < 2:
        raise DyngsError(
            f"could not estimate poses for {len(images)} cameras: neighbouring cameras must "
            "overlap, with at most 30 degrees between them, and see textured static surfaces; "
            "add cameras between them, or give the poses in cameras.json (`dyngs docs captures`)"
        )
    line = (
        f"{len(names)} of {len(images)} cameras registered, {model.num_points3D():,} points, "
        f"mean error {model.compute_mean_reprojection_error():.2f} px ({lens})"
    )
    left = [name for name in images if name not in names]
    if left:
        line += f"; not registered: {first_few(left)}"
    return model, line


def _posed_images(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    """Return the images of a model that have a pose, by the name of their camera."""
    return {Path(image.name).stem: image for image in model.images.values() if image.has_pose}


def _is_better(one: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> bool:
    if one.num_reg_images() != other.num_reg_images():
        return one.num_reg_images() > other.num_reg_images()
    error = one.compute_mean_reprojection_error()
    return error < LESS_ERROR * other.compute_mean_reprojection_error()


def _mapped(folder: Path, shared: bool, num_threads: int) -> pycolmap.Reconstruction | None:
    """Return the best model of the images in ``folder/images``, with one lens for all of a size or
    a lens each."""
    import pycolmap

    work = folder / f"shared_{shared}"
    work.mkdir()
    database = work / "database.db"
    device = pycolmap.Device.cpu
    extraction = feature_options(num_threads, LONGEST_SIDE, MAX_FEATURES)
    extraction.sift.peak_threshold = 0.002
    mode = pycolmap.CameraMode.PER_FOLDER if shared else pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(
        database,
        folder / "images",
        camera_mode=mode,
        reader_options=pycolmap.ImageReaderOptions(camera_model=LENS),
        extraction_options=extraction,
        device=device,
    )
    matching, verification = matching_options(num_threads)
    pycolmap.match_exhaustive(database, matching, verification_options=verification, device=device)
    models: list[pycolmap.Reconstruction] = []
    for seed in MAPPING_SEEDS:
        mapping = incremental_options(num_threads, SEED + seed)
        mapping.min_model_size = 2
        mapping.mapper.init_min_num_inliers = 40
        mapping.mapper.abs_pose_min_num_inliers = 20
        mapping.triangulation.ignore_two_view_tracks = False
        target = work / f"models_{seed}"
        target.mkdir()
        found = pycolmap.incremental_mapping(database, folder / "images", target, mapping)
        models += found.values()
    best = max(
        models, key=lambda x: (x.num_reg_images(), x.compute_num_observations()), default=None
    )
    if best is not None:
        _refine(best, num_threads)
    return best


def _refine(model: pycolmap.Reconstruction, num_threads: int) -> None:
    """Adjust poses, lenses and points once more, with a robust loss, and without what fits badly or
    two cameras see.

    Repeated patterns give matches that only two cameras agree on; those bend the model.
    """
    import pycolmap

    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    adjustment.ceres.loss_function_scale = 0.5
    adjustment.ceres.solver_options.num_threads = num_threads or -1
    for _ in range(2):
        problem = pycolmap.BundleAdjustmentConfig()
        for image in _posed_images(model).values():
            problem.add_image(image.image_id)
        problem.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        # Not pycolmap.bundle_adjustment, which turns COLMAP's log on.
        pycolmap.create_default_bundle_adjuster(adjustment, problem, model).solve()
        model.update_point_3d_errors()
        pycolmap.ObservationManager(model).filter_all_points3D(LARGEST_ERROR, 1.5)
        _drop_pairs(model)
    model.update_point_3d_errors()


def _drop_pairs(model: pycolmap.Reconstruction) -> None:
    """Remove points of two cameras where each camera has enough others."""
    pairs = [key for key, point in model.points3D.items() if point.track.length() == 2]
    others = set(model.points3D) - set(pairs)
    counts = Counter(
        element.image_id for key in others for element in model.points3D[key].track.elements
    )
    if min((counts[x.image_id] for x in _posed_images(model).values()), default=0) >= ENOUGH_TRACKS:
        for key in pairs:
            model.delete_point3D(key)


# Frames and the written model


def frames_at_steps(
    where: Path,
    videos: Sequence[CameraVideo],
    starts: Mapping[str, float],
    most: int | None = None,
) -> tuple[list[dict[int, float]], str]:
    """Return the frames of each video at the time steps that all of them show, number to second in
    the clock of all, and a line on how many.

    Time steps are frames of the video with the fewest per second. Of the others the nearest frame
    is taken, at its own time if that differs. Raises DyngsError: no two time steps that all videos
    show.

    Args:
        most: time steps at most, evenly spaced; None: ``MOST_STEPS``, fewer where there are many
            cameras.
    """
    clocks = [video.seconds + starts[video.name] for video in videos]
    first = max(clock[0] for clock in clocks)
    last = min(clock[-1] for clock in clocks)
    slowest = min(range(len(videos)), key=lambda i: (videos[i].rate, i))
    slack = 0.5 / videos[slowest].rate
    steps = clocks[slowest][(clocks[slowest] >= first - slack) & (clocks[slowest] <= last + slack)]
    if len(steps) < 2:
        raise DyngsError(
            f"{where}: the videos do not overlap in time: the last one starts at {first:.2f} s, "
            f"the first one ends at {last:.2f} s; check that all show the same event"
        )
    limit = max(min(MOST_STEPS, MOST_IMAGES // len(clocks)), 2) if most is None else most
    chosen = steps[evenly_spaced(len(steps), limit)]
    line = f"{len(chosen)} time steps over {chosen[-1] - chosen[0]:.2f} s seen by all {len(clocks)} cameras"
    if len(chosen) < len(steps):
        line += f", of {len(steps)} (choose with --frames of `dyngs data sfm`)"
    frames: list[dict[int, float]] = []
    for video, clock in zip(videos, clocks, strict=True):
        nearest = np.abs(clock[:, None] - chosen).argmin(axis=0)
        own = clock[nearest]
        own = np.where(np.abs(own - chosen) <= SAME_STEP / video.rate, chosen, own)
        frames.append(dict(zip(nearest.tolist(), own.tolist(), strict=True)))
    return frames, line


def _write_images(
    root: Path,
    videos: Sequence[CameraVideo],
    frames: Sequence[dict[int, float]],
    report: ProgressCallback,
) -> dict[str, float]:
    """Write the frames as ``root/images/CAMERA/frame_NNNNN.png``; return name to second."""
    total = sum(map(len, frames))
    seconds: dict[str, float] = {}
    for video, own in zip(videos, frames, strict=True):
        for number, rgb in read_numbered_frames(video.path, list(own)):
            name = f"{video.name}/frame_{number:05d}.png"
            write_image(root / "images" / name, rgb)
            seconds[name] = round(own[number], 6)
            report("frames of the videos", len(seconds), total)
    return seconds


def _write_model(
    root: Path,
    static: pycolmap.Reconstruction,
    posed: Mapping[str, pycolmap.Image],
    cameras: Sequence[str],
    names: Sequence[str],
) -> None:
    """Write ``root/sparse/0``: a lens for each camera, its one pose for all its images, and the
    points.

    The first image of each camera has the observations of the points.
    """
    import pycolmap

    full = pycolmap.Reconstruction()
    first_ids: dict[int, int] = {}
    for image_id, name in enumerate(names, start=1):
        camera = name.partition("/")[0]
        image = posed[camera]
        number = cameras.index(camera) + 1
        seen = np.zeros((0, 2))
        if image.image_id not in first_ids:
            first_ids[image.image_id] = image_id
            lens = static.cameras[image.camera_id]
            fields = {key: getattr(lens, key) for key in ("model", "width", "height", "params")}
            full.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=number, **fields))
            seen = np.array([point.xy for point in image.points2D], np.float64).reshape(-1, 2)
        new = pycolmap.Image(name=name, keypoints=seen, camera_id=number, image_id=image_id)
        full.add_image_with_trivial_frame(new, image.cam_from_world())
    for key in sorted(static.points3D):
        point = static.points3D[key]
        track = pycolmap.Track()
        for element in point.track.elements:
            if element.image_id in first_ids:
                track.add_element(first_ids[element.image_id], element.point2D_idx)
        full.add_point3D(point.xyz, track, point.color)
    full.update_point_3d_errors()
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    full.write(folder)
