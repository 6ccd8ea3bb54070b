# ruff: noqa: E501  (a table, one mutation to a line)
"""Breaks one place at a time and says which of the nearest tests notices: `python
benchmarks/mutate.py [WORD]`.

Run from a clean checkout; only places whose line holds WORD are tried. A file is changed for as
long as its tests run, and restored whatever happens. A mutation that no test notices wants a test;
one whose text is gone wants a new one.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import hypothesis  # noqa: F401  here, so that each fork need not
import pytest
import scipy.spatial.transform  # noqa: F401
import torch  # noqa: F401

ROOT = Path(__file__).resolve().parents[1]
MISSED = "NOT NOTICED"
SECONDS = 240
"""Tests that take longer have noticed: what is broken may never end."""

# file, what is there once, what is put in its place, tests
MUTATIONS = (
    ("api/choose.py", "gains = [now - then", "gains = [then - now", "api/test_choose.py"),
    ("api/choose.py", "moving if choice.taken else as_static(config)", "as_static(config) if choice.taken else moving", "api/test_choose.py"),
    ("api/choose.py", '[_with(small, "model", motion_from=1.0), small]', '[small, _with(small, "model", motion_from=1.0)]', "api/test_choose.py"),
    ("api/choose.py", "if moves is False:", "if moves is True:", "api/test_choose.py test_quality.py"),
    ("api/choose.py", "moves = fraction > MIN_DIFFERING", "moves = fraction < MIN_DIFFERING", "api/test_choose.py test_quality.py"),
    ("io/formats/antimatter.py", "* 255).round()", "* 255)", "io/formats/test_formats.py"),
    ("io/formats/antimatter.py", "* 128 + 128).round()", "* 128 + 128)", "io/formats/test_formats.py"),
    ("io/formats/antimatter.py", "descending=True", "descending=False", "io/formats/test_formats.py"),
    ("io/formats/spz.py", "_COLOUR_SCALE = 0.15", "_COLOUR_SCALE = 0.25", "io/formats/test_formats.py"),
    ("io/formats/spz.py", "/ 16 - 10)", "/ 8 - 10)", "io/formats/test_formats.py"),
    ("io/formats/spz.py", "- 128) / 128", "- 127) / 128", "io/formats/test_formats.py"),
    ("io/formats/spz.py", "others < 0", "others > 0", "io/formats/test_formats.py"),
    ("io/formats/gltf.py", '"colorSpace": "srgb_rec709_display"', '"colorSpace": "lin_rec709_display"', "io/formats/test_formats.py"),
    ("io/formats/gltf.py", 'for key in ("kernel", "colorSpace")', 'for key in ("kernel",)', "io/formats/test_formats.py"),
    ("core/conventions.py", "((signal + 0.055) / 1.055) ** 2.4", "signal", "io/formats/test_formats.py"),
    ("io/formats/ply.py", "_SH_RANGE = 8.0", "_SH_RANGE = 4.0", "io/formats/test_ply.py io/formats/test_formats.py"),
    ("io/formats/ply.py", "+ 0.5) / 256))", ") / 256))", "io/formats/test_ply.py io/formats/test_formats.py"),
    ("io/formats/ply.py", "_BITS_3 = (11, 10, 11)", "_BITS_3 = (10, 11, 11)", "io/formats/test_formats.py"),
    ("io/formats/sog.py", "_MODE = 252", "_MODE = 250", "io/formats/test_formats.py"),
    ("io/formats/packing.py", "* top + 0.5)", "* top)", "io/formats/test_formats.py"),
    ("gaussians/densify.py", "opaque = parameters.opacities >=", "opaque = parameters.opacities >", "gaussians/test_densify.py"),
    ("gaussians/densify.py", "& (scale <= max_scale)", "& (scale < max_scale)", "gaussians/test_densify.py"),
    ("gaussians/densify.py", "score >= options.grad_threshold", "score > options.grad_threshold", "gaussians/test_densify.py"),
    ("gaussians/densify.py", "large = scale > DENSE_FRACTION * reference_length", "large = scale >= DENSE_FRACTION * reference_length", "gaussians/test_densify.py"),
    ("gaussians/densify.py", "wanted & large & (scale / SPLIT_SHRINK <= max_scale)", "wanted & large", "gaussians/test_densify.py"),
    ("gaussians/densify.py", "wanted & large & (scale / SPLIT_SHRINK <= max_scale)", "wanted & large & (scale <= max_scale)", "gaussians/test_densify.py"),
    ("gaussians/densify.py", "wanted & ~large & survives", "wanted & ~large", "gaussians/test_densify.py"),
    ("gaussians/densify.py", "torch.where(split & ~survives, 2, 1)", "torch.where(split, 1, 1)", "gaussians/test_densify.py"),
    ("gaussians/densify.py", "step > self.schedule.prune_scale_after", "step >= self.schedule.prune_scale_after", "gaussians/test_densify.py"),
    ("gaussians/densify.py", "DENSE_FRACTION = 0.01", "DENSE_FRACTION = 0.02", "gaussians/test_densify.py"),
    ("gaussians/densify.py", "PRUNE_SCALE = 0.1", "PRUNE_SCALE = 0.2", "gaussians/test_densify.py"),
    ("gaussians/densify.py", "distance > FAR * self.extent", "distance >= FAR * self.extent", "gaussians/test_densify.py"),
    ("gaussians/densify.py", "opacities > self.options.prune_opacity", "opacities < self.options.prune_opacity", "gaussians/test_mcmc.py"),
    ("gaussians/densify.py", "(1 + self.growth) * n", "(2 + self.growth) * n", "gaussians/test_mcmc.py"),
    ("gaussians/densify.py", "NOISE_STEEPNESS = 100.0", "NOISE_STEEPNESS = -100.0", "gaussians/test_mcmc.py"),
    ("data/scene_space.py", "EXTENT_MARGIN = 1.1", "EXTENT_MARGIN = 1.3", "gaussians/test_initialization.py"),
    ("gaussians/initialization.py", "order[seen < min(MIN_VIEWS", "order[seen > min(MIN_VIEWS", "gaussians/test_initialization.py"),
    ("gaussians/schedule.py", "(1 - REWIND) * tuned", "REWIND * tuned", "gaussians/test_schedule.py"),
    ("gaussians/filters.py", "FILTER_VARIANCE = 0.2", "FILTER_VARIANCE = 0.3", "gaussians/test_filters.py"),
    ("gaussians/visibility.py", "self.bits[interval] | self.bits[interval + 1]", "self.bits[interval]", "gaussians/test_visibility.py"),
    ("gaussians/optimizer.py", "moved[~is_new] = x[source[~is_new]]", "moved[:] = x[source]", "gaussians/test_parameters.py"),
    ("gaussians/optimizer.py", "decay**progress if", "decay * progress if", "gaussians/test_parameters.py"),
    ("deform/training.py", "2 * longest *", "longest *", "deform/test_motion.py"),
    ("deform/schedule.py", "oldest <= abs(time - MIDDLE) <= newest", "oldest < abs(time - MIDDLE) <= newest", "deform/test_time_window.py"),
    ("deform/schedule.py", "step % 2 == 0", "step % 2 == 1", "deform/test_time_window.py"),
    ("deform/static_errors.py", "TYPICAL_QUANTILE = 0.7", "TYPICAL_QUANTILE = 0.3", "deform/test_static_errors.py"),
    ("deform/static_errors.py", "gap = gap - gap.flatten(1)", "gap = gap - 0 * gap.flatten(1)", "deform/test_static_errors.py"),
    ("deform/gaussians_4d.py", "[left.abs().argmax(1)]", "[left.argmax(1)]", "deform/test_gaussians_4d.py"),
    ("export/edit/crop.py", "inside |= exists & region", "inside |= region", "deform/test_gaussians_4d.py"),
    ("deform/scene.py", "rows = torch.nonzero(descent >= 0)", "rows = torch.nonzero(descent > 0)", "deform/test_scene.py"),
    ("human/avatar/posing.py", "height == min(heights)", "height == max(heights)", "human/avatar/test_anchors.py"),
    ("ops/harmonics.py", "3 * z * z - 1", "3 * z * z", "ops/test_harmonics.py"),
    ("ops/harmonics.py", "by_terms[6], y, value=-2", "by_terms[6], y, value=2", "ops/test_harmonics.py"),
    ("human/body/skinning.py", "(above - rotations).mT", "above.mT", "human/body/test_skinning.py"),
    ("human/body/skinning.py", "along * poses", "along", "human/body/test_skinning.py"),
    ("human/avatar/posing.py", "features[1:].flatten()", "rotations[1:].flatten()", "human/avatar/test_posing.py human/avatar/test_scene.py"),
    ("training/trainer.py", "self._position += 1", "self._position += 2", "training/test_trainer.py"),
    ("models/schedule.py", "step / options.steps >= fraction", "step / options.steps > fraction", "gaussians/test_schedule.py training/test_clock.py"),
    ("gaussians/schedule.py", "range(period, stop - period + 1, period)", "range(period, stop, period)", "gaussians/test_schedule.py"),
    ("gaussians/schedule.py", "(1 - progress) * math.log(options.lr_means)", "progress * math.log(options.lr_means)", "gaussians/test_schedule.py"),
    ("training/corrections/exposure.py", "composite(view.background) >= SATURATED", "composite(view.background) >= 9", "training/corrections/test_exposure.py"),
    ("evaluate/motion_masks.py", "2 * at[..., :2]", "3 * at[..., :2]", "evaluate/test_motion_masks.py"),
    ("evaluate/view_scores.py", "else part & foreground", "else part", "evaluate/test_regions.py"),
    ("evaluate/view_scores.py", "psnr(rendering.rgb[0][:, middle:], truth[:, middle:], mask)", "psnr(rendering.rgb[0][:, :middle], truth[:, :middle], mask)", "evaluate/test_view_scores.py"),
    ("evaluate/view_scores.py", "rendering.transmittance[0][..., None] * background", "0 * background", "evaluate/test_view_scores.py"),
    ("compress/stage.py", "VOLUME_POWER = 0.1", "VOLUME_POWER = -0.1", "compress/test_scores.py"),
    ("compress/stage.py", "softplus(-2 * (x", "softplus(2 * (x", "compress/test_scores.py"),
    ("compress/search.py", "max(self.loss, self.trained_loss)", "self.loss", "compress/test_search.py"),
    ("compress/search.py", "keeps = tried.worst <= allowed", "keeps = tried.worst >= allowed", "compress/test_search.py"),
    ("compress/clean.py", "most > MAIN_FRACTION * total", "most < MAIN_FRACTION * total", "compress/test_floaters.py"),
    ("compress/clean.py", "count > MOST * len(found)", "count > 10 * len(found)", "compress/test_floaters.py"),
    ("api/budget/count.py", "if count <= self.most or", "if count <= 2 * self.most or", "api/budget/test_count.py"),
    ("runs/stored_file.py", "np.floor(np.abs(scaled) + rounding)", "np.floor(np.abs(scaled))", "runs/test_stored_values.py"),
    ("runs/stored_file.py", "step / 8, 1 - step / 64", "step / 8, 1", "runs/test_stored_values.py"),
    ("compress/measure.py", "MOST_VISIBLE = 0.9", "MOST_VISIBLE = 0.1", "compress/test_precision.py"),
    ("compress/measure.py", "octaves = -0.5 *", "octaves = -1.0 *", "compress/test_precision.py"),
    ("runs/stored_file.py", "whole << 1 ^ whole >> 63", "whole << 1", "runs/test_stored_file.py"),
    ("export/splat_files.py", "positions = frame.points(positions)", "positions = frame.inverse().points(positions)", "export/test_splat_files.py"),
    ("export/html/scene_data.py", "np.where(step > 0, step, 1)", "np.where(step > 0, 2 * step, 1)", "export/test_scene_data.py"),
    ("export/html/scene_data.py", "np.roll(quats, 1, axis=1)", "np.roll(quats, 2, axis=1)", "export/test_scene_data.py export/test_pages.py"),
    ("runs/checkpoint.py", "[:-KEEP_CHECKPOINTS]", "[KEEP_CHECKPOINTS:]", "runs/test_checkpoint.py"),
    ("runs/checkpoint.py", "if int(s) < step}", "if int(s) != step}", "runs/test_checkpoint.py"),
    ("io/outputs.py", "fcntl.LOCK_EX | fcntl.LOCK_NB", "fcntl.LOCK_SH | fcntl.LOCK_NB", "io/test_lock.py"),
    ("runs/folder.py", "if not same or checkpoint_paths(folder)", "if not same", "runs/test_folder.py"),
    ("runs/folder.py", "RunConfig(seed=config.run.seed)", "RunConfig()", "runs/test_folder.py"),
    ("io/containment.py", "amount > most and amount > scaled_limit(most)", "amount > most", "io/test_limits.py"),
    ("io/containment.py", "startswith(root.rstrip(os.sep) + os.sep)", "startswith(root.rstrip(os.sep))", "io/test_containment.py"),
    ("io/containment.py", "max(channels, 4)", "4", "io/test_containment.py"),
    ("io/outputs.py", "if folder in self.paths:", "if folder in ():", "io/test_outputs.py"),
    ("data/geometry.py", "error > ROTATION_TOLERANCE or determinant <= 0", "error > ROTATION_TOLERANCE", "data/test_geometry.py data/readers/test_blender.py"),
    ("data/geometry.py", "np.diag([1.0, -1.0, -1.0, 1.0])", "np.diag([1.0, 1.0, 1.0, 1.0])", "data/readers/test_blender.py"),
    ("data/scene_space.py", "1 / far + unit[:, 3] * (1 / near - 1 / far)", "1 / near + unit[:, 3] * (1 / near - 1 / far)", "data/test_scene_space.py"),
    ("data/scene_space.py", "factor * (capture.points.xyz - shift)", "factor * (capture.points.xyz + shift)", "data/test_scene_space.py"),
    ("data/times.py", "max(gaps) < _EVEN * min(gaps)", "max(gaps) >= min(gaps)", "data/test_times.py"),
    ("data/times.py", "len(times) < len(all_views(splits))", "False", "data/test_times.py"),
    ("data/images/lens.py", "*lens.params[4:]", "*lens.params[5:]", "data/images/test_lens.py"),
    ("data/readers/colmap.py", "fy = values[num_focal - 1]", "fy = values[0]", "data/readers/test_colmap.py"),
    ("export/camera_paths.py", "slopes[:-1] * steps[1:] + slopes[1:] * steps[:-1]", "slopes[:-1] * steps[:-1] + slopes[1:] * steps[1:]", "export/test_camera_paths.py"),
    ("export/camera_paths.py", "np.log(keys.intrinsics[index, axis, axis])", "(keys.intrinsics[index, axis, axis])", "export/test_camera_paths.py"),
    ("data/geometry.py", "values[0] < 0.2**2", "values[0] < 9", "export/test_orbits.py"),
    ("export/orbits.py", "-np.sin(2 * phase)", "np.sin(2 * phase)", "export/test_orbits.py"),
    ("export/orbits.py", "order = np.argsort(seconds)", "order = np.arange(len(seconds))", "export/test_orbits.py"),
)  # fmt: skip


def outcome(tests: str) -> str:
    """Return the first test that fails, or what else happened; in a fork, which has all packages
    but this one."""
    with tempfile.TemporaryFile("w+") as output:
        child = os.fork()
        if child == 0:
            os.dup2(output.fileno(), 1)
            signal.alarm(SECONDS)
            os.chdir(ROOT)
            os._exit(
                pytest.main(
                    [
                        "-q",
                        "-x",
                        "-p",
                        "no:cacheprovider",
                        *(f"tests/{path}" for path in tests.split()),
                    ]
                )
            )
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        output.seek(0)
        failed = [line for line in output if line.startswith(("FAILED", "ERROR"))]
    if status == -signal.SIGALRM:
        return "takes too long"
    return (
        failed[0].strip().split(" - ")[0]
        if failed
        else MISSED
        if status == 0
        else f"ended with {status}"
    )


def main() -> int:
    """Try all mutations and return how many were not noticed."""
    sys.dont_write_bytecode = True
    missed = 0
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    for name, old, new, tests in MUTATIONS:
        if word not in f"{name} {old} {tests}":
            continue
        path = ROOT / "dyngs" / name
        begun = time.monotonic()
        text = path.read_text(encoding="utf-8")
        if text.count(old) != 1:
            print(f"{name}: {old!r} is there {text.count(old)} times: GONE", flush=True)
            missed += 1
            continue
        try:
            path.write_text(text.replace(old, new), encoding="utf-8")
            found = outcome(tests)
        finally:
            path.write_text(text, encoding="utf-8")
        missed += found == MISSED
        print(f"{name}: {old!r} -> {new!r}: {found} ({time.monotonic() - begun:.0f} s)", flush=True)
    return missed


if __name__ == "__main__":
    sys.exit(main())
