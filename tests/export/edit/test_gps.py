"""Positions in EXIF, forged for cameras whose place in the world is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from moving_scene import write_moving_run
from PIL import Image

from dyngs.data.capture import all_views
from dyngs.export.edit.frame import east_north_up, gps_frame
from dyngs.io.formats.similarity import Similarity
from dyngs.runs.opened import open_run

# from the scene to metres east, north and up
WORLD = Similarity((0.5, 0.5, -0.5, 0.5), 3.0, (40.0, -20.0, 7.0))
ORIGIN = (48.1371, -11.5754, 519.0)
METRES = 6_371_000 * np.pi / 180  # of a degree of latitude, nearly


def stamp(path: Path, latitude: float, longitude: float, altitude: float | None) -> None:
    """Write a position into a photo."""
    with Image.open(path) as image:
        exif = Image.Exif()
        pixels = image.copy()
    told = {1: "S" if latitude < 0 else "N", 2: (int(abs(latitude)), 0.0, abs(latitude) % 1 * 3600)}
    told |= {
        3: "W" if longitude < 0 else "E",
        4: (int(abs(longitude)), abs(longitude) % 1 * 60, 0.0),
    }
    if altitude is not None:
        told |= {5: b"\1" if altitude < 0 else b"\0", 6: abs(altitude)}
    exif[0x8825] = told
    pixels.save(path, exif=exif)


def centres_of(run: Path) -> dict[Path, np.ndarray]:
    """Photos and the places of their cameras."""
    views = all_views(open_run(run).capture.splits)
    return {v.image_path: -v.cam_from_world[:3, :3].T @ v.cam_from_world[:3, 3] for v in views}


def stamped(run: Path, *, noise: float = 0.0, count: int = 99, flat: bool = False) -> None:
    """Write positions into ``count`` photos of a run; ``flat``: as if the cameras stood on a
    line."""
    random = np.random.default_rng(0)
    for i, (path, centre) in enumerate(list(centres_of(run).items())[:count]):
        metres = (
            WORLD.points(centre) if not flat else np.array([3.0 * i, 2.0 * i, 0.0])
        ) + noise * random.normal(size=3)
        latitude = ORIGIN[0] + metres[1] / METRES
        longitude = ORIGIN[1] + metres[0] / METRES / np.cos(np.radians(ORIGIN[0]))
        stamp(path, latitude, longitude, ORIGIN[2] + metres[2])


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_moving_run(tmp_path, moves=False)


def test_north_up_and_metres(run: Path) -> None:
    """The sphere that the positions are forged on differs from the ellipsoid by 0.3 %."""
    stamped(run)
    found = gps_frame(open_run(run))
    assert found.similarity.scale == pytest.approx(WORLD.scale, rel=0.005)
    np.testing.assert_allclose(found.similarity.rotation, WORLD.rotation, atol=0.005)
    assert found.lines[0].startswith("8 photos with a position: scale 3")
    assert "x is east, y north, z up" in found.lines[1]


def test_the_tangent_plane() -> None:
    """Known lengths of WGS84: a degree of latitude is 110.574 km at the equator, one of longitude
    111.320 km."""
    origin = np.zeros(3)
    near = east_north_up(np.array([[1e-3, 0, 0], [0, 1e-3, 0], [0, 0, 5.0]]), origin)
    np.testing.assert_allclose(near, [[0, 110.574, 0], [111.320, 0, 0], [0, 0, 5]], atol=2e-3)
    at_pole = east_north_up(np.array([[89.999, 0.0, 0.0]]), np.array([90.0, 0.0, 0.0]))
    np.testing.assert_allclose(at_pole, [[0, -111.694, 0]], atol=2e-3)
