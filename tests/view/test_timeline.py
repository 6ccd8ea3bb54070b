import pytest

from dyngs.view.timeline import Timeline


def test_time_passes_only_while_it_plays() -> None:
    still = Timeline(seconds=4).moved(0.5, 10.0)
    assert still.at(99.0) == 0.5
    playing = still.changed(10.0, playing=True)
    assert playing.at(11.0) == pytest.approx(0.75)
    assert playing.changed(11.0, speed=2.0).at(11.25) == pytest.approx(0.875)
    assert playing.changed(11.0, playing=False).at(50.0) == pytest.approx(0.75)


def test_a_loop_begins_again_and_no_loop_ends() -> None:
    loop = Timeline(seconds=2).changed(0.0, playing=True)
    assert loop.at(2.5) == pytest.approx(0.25)
    assert not loop.is_over(2.5)
    once = loop.changed(0.0, loops=False)
    assert once.at(2.5) == 1.0
    assert once.is_over(2.5)
    assert once.changed(3.0, playing=False).changed(5.0, playing=True).at(5.0) == 0.0


def test_a_time_that_is_set_stays_within_the_recording() -> None:
    assert Timeline().moved(7.0, 0.0).time == 1.0
    assert Timeline().moved(-7.0, 0.0).time == 0.0
