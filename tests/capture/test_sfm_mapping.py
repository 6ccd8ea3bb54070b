"""Which model of mapping is taken."""

from __future__ import annotations

import pycolmap
import pytest

from dyngs.capture.sfm_mapping import SfmModel, better


def _model(focal: float, known: bool = False) -> SfmModel:
    found = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal, 480, 270)
    camera.has_prior_focal_length = known
    found.add_camera(camera)
    return SfmModel(found, "global", 1.0)


@pytest.mark.parametrize(
    ("focal", "known", "real"), [(400, False, True), (6100, False, False), (6100, True, True)]
)
def test_a_focal_length_of_many_widths_is_no_lens_unless_exif_says_so(
    focal: float, known: bool, real: bool
) -> None:
    assert _model(focal, known).has_real_lens == real


def test_the_model_with_a_real_lens_is_taken() -> None:
    real = _model(400)
    unreal = _model(6100)
    assert better(unreal, real) is real
    assert better(real, unreal) is real
