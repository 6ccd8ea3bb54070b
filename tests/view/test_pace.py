import pytest

from dyngs.view.pace import SMALLEST_AREA, Pace, size_within


def run(
    pace: Pace, fixed: float, per_pixel: float, full: int = 800 * 600, count: int = 40
) -> float:
    """The area that settles where an image takes ``fixed + per_pixel * pixels`` seconds, refined
    now and then."""
    for i in range(count):
        area = pace.next_area(full, None)
        pace.observe(area, fixed + per_pixel * area, is_refined=False)
        if i % 5 == 0:
            pace.observe(full, fixed + per_pixel * full, is_refined=True)
    return pace.next_area(full, None)


def test_images_take_as_long_as_they_may() -> None:
    assert 0.01 + 1e-6 * run(Pace(0.07), 0.01, 1e-6) == pytest.approx(0.07, rel=0.05)


def test_a_fast_scene_is_always_drawn_whole() -> None:
    assert run(Pace(0.07), 1e-4, 1e-9) == 800 * 600


def test_images_do_not_vanish_where_gaussians_take_all_the_time() -> None:
    area = run(Pace(0.07), 0.2, 1e-6)
    # half as long for the pixels as for the Gaussians
    assert area == pytest.approx(0.1 / 1e-6, rel=0.1)


def test_a_hopeless_scene_keeps_the_smallest_images() -> None:
    assert run(Pace(0.07), 0.0, 1.0) == SMALLEST_AREA


def test_a_still_image_is_refined_in_steps_up_to_the_whole() -> None:
    pace = Pace(0.07)
    area = 20_000.0
    steps = 0
    while area < 1_000_000:
        area = pace.next_area(1_000_000, area)
        steps = steps + 1
    assert area == 1_000_000
    assert steps == 3


def test_no_image_takes_longer_than_the_longest() -> None:
    pace = Pace(0.05, longest=0.3)
    run(pace, 0.05, 1e-6, full=2_000_000)
    assert pace.largest == pytest.approx(0.25 / 1e-6, rel=0.05)


@pytest.mark.parametrize(
    ("area", "size"), [(1e9, (800, 600)), (120_000, (400, 300)), (1, (16, 16))]
)
def test_size_keeps_the_aspect(area: float, size: tuple[int, int]) -> None:
    assert size_within((800, 600), area) == size
