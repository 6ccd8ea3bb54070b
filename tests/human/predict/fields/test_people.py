"""Bodies, images and views of captured people, in metres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dyngs.human.avatar.observations import project_points
from dyngs.human.predict.gps.rectification import rings_of_views, spread
from dyngs.human.predict.people import (
    Person,
    cameras_in_metres,
    crop_source_images,
)


def test_key_points_lie_in_the_person(person: Person) -> None:
    """In all images, once metres are the units of the world."""
    body, scale = person.body_in(person.views[0])
    for image in person.images:
        at, _, _ = project_points(body.key_points, cameras_in_metres(image.cameras, scale))
        column, row = at.long().unbind(1)
        assert image.alpha is not None
        assert float((image.alpha[row, column] > 0).float().mean()) > 0.9
    low = body.vertices.amin(0)
    high = body.vertices.amax(0)
    assert 1.2 < float((high - low).max()) < 2.4
    assert scale != 1


def test_metres_look_the_same(person: Person) -> None:
    """The silhouette of the body lies where the image shows the person."""
    body, scale = person.body_in(person.views[0])
    image = person.images[0]
    at, _, _ = project_points(body.vertices, cameras_in_metres(image.cameras, scale))
    expected, _, _ = project_points(scale * body.vertices, image.cameras)
    torch.testing.assert_close(at, expected, atol=1e-3, rtol=0)
    column, row = at.long().unbind(1)
    assert image.alpha is not None
    assert float((image.alpha[row, column] > 0).float().mean()) > 0.9


def test_sources_are_the_images_around_the_person(person: Person) -> None:
    """Crops are padded to one size, and features at a point equal those of the whole image."""
    images = [person.images[i] for i in (0, 2, 5)]
    body, scale = person.body_in(person.views[0])
    sources = crop_source_images(images, scale)
    height, width = sources.rgba.shape[2:]
    assert (height % 8, width % 8, len(sources.rgba)) == (0, 0, 3)
    for i, image in enumerate(images):
        assert image.alpha is not None
        assert float(sources.rgba[i, 3].sum()) == pytest.approx(float(image.alpha.sum()))
        whole = torch.cat([image.rgb_premultiplied, image.alpha[..., None]], -1)
        cut = sources.rgba[i].permute(1, 2, 0)
        found = []
        for camera, rgba in (
            (sources.cameras.select(i), cut),
            (cameras_in_metres(image.cameras, scale), whole),
        ):
            at, _, _ = project_points(body.key_points[:12], camera)
            column, row = at.long().unbind(1)
            found.append(rgba[row, column])
        torch.testing.assert_close(*found)
        torch.testing.assert_close(sources.cameras.centers[i], image.cameras.centers[0] / scale)


def test_views_are_spread_around_a_moment(person: Person) -> None:
    views = person.views
    (ring,) = rings_of_views(views)
    assert sorted(ring) == list(range(len(views)))
    angles = np.unwrap([np.arctan2(*views[i].cam_from_world[2, [0, 2]]) for i in ring])
    assert (np.diff(angles) > 0).all() or (np.diff(angles) < 0).all()
    assert spread(range(12), 4) == [0, 3, 6, 9]
    assert spread(range(12), 3, 11) == [11, 3, 7]
    later = [replace(view, frame=1, time=0.5) if i % 2 else view for i, view in enumerate(views)]
    assert [len(x) for x in rings_of_views(later)] == [
        (len(views) + 1) // 2,
        len(views) // 2,
    ]
