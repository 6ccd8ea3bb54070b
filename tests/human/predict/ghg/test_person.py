"""Which views are chosen of a ring of cameras, and captures that will not do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_people import body, people, person

from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.read import read_capture
from dyngs.human.predict.ghg.network import AtlasPerson, spread_views
from dyngs.human.predict.people import captured_person


@pytest.fixture(scope="module")
def sitter(tmp_path_factory: pytest.TempPathFactory) -> AtlasPerson:
    return person(people(tmp_path_factory.mktemp("people"), (1,)) / "p1")


def gaps(sitter: AtlasPerson, chosen: list[int]) -> list[float]:
    """Degrees between neighbours on the ring, all around."""
    centers = [
        -v.cam_from_world[:3, :3].T @ v.cam_from_world[:3, 3]
        for v in (sitter.person.views[i] for i in chosen)
    ]
    azimuths = np.sort([np.degrees(np.arctan2(c[0], c[2])) % 360 for c in centers])
    return sorted(np.diff([*azimuths, azimuths[0] + 360]))


def test_chosen_views_are_spread_around_the_person(sitter: AtlasPerson) -> None:
    """Of eight cameras 45 degrees apart, three leave no gap above 135 degrees, two are opposite,
    four every other."""
    np.testing.assert_allclose(gaps(sitter, spread_views(sitter, 3)), [90, 135, 135])
    np.testing.assert_allclose(gaps(sitter, spread_views(sitter, 2)), [180, 180])
    np.testing.assert_allclose(gaps(sitter, spread_views(sitter, 4)), [90, 90, 90, 90])
    assert len(spread_views(sitter, 1)) == 1
    assert spread_views(sitter, 8) == list(range(8))
    assert spread_views(sitter, 20) == list(range(8))


def test_a_sitter_has_a_disc_per_texel_and_scaffold(sitter: AtlasPerson) -> None:
    assert sitter.heights == (0.0, 0.02)
    assert len(sitter.scene) == len(sitter.scene.anchors) == 2 * len(sitter.texels)
    assert sitter.person.body.num_shapes == 0
    away = (sitter.scene.gaussians.means[len(sitter.texels) :] - sitter.texels.points).norm(dim=1)
    np.testing.assert_allclose(away.numpy(), 0.02, atol=1e-6)  # float32


def test_captures_without_a_body_or_silhouettes_are_refused(
    sitter: AtlasPerson, tmp_path: Path
) -> None:
    capture = read_capture(DataConfig.model_validate({"root": people(tmp_path, (2,)) / "p2"}))
    with pytest.raises(DyngsError, match="no body parameters"):
        captured_person(capture.replace(body=None), body(), sitter.person.images)
    with pytest.raises(DyngsError, match="no silhouettes"):
        captured_person(capture.replace(has_alpha=False), body(), sitter.person.images)
