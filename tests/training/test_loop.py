"""The loop emits events in order to every listener, for every kind of trainer."""

from __future__ import annotations

import signal
from collections.abc import Callable
from functools import partial

import pytest
from steps import Counting

from dyngs.core.errors import DyngsError
from dyngs.training.clock import Stopwatch
from dyngs.training.events import Event, Message, Paused, Started, StepDone
from dyngs.training.loop import Interrupts, Loop

SIGNALS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]


def looped(
    trainer: Counting,
    total: int,
    *listeners: Callable[[Event], None],
    advice: Callable[[], str] | None = None,
) -> Loop:
    loop = Loop(trainer, total, Stopwatch(), advice)
    loop.subscribe(*listeners)
    return loop


def test_events_reach_all_listeners_in_order() -> None:
    """Messages of a step are emitted before its end; listeners are called in the order in which
    they were added."""
    told: list[tuple[str, Event]] = []
    trainer = Counting(messages={2: "something"})
    loop = looped(
        trainer, 3, lambda e: told.append(("first", e)), lambda e: told.append(("second", e))
    )
    loop.run()
    assert [name for name, _ in told] == ["first", "second"] * 5
    assert all(a[1] is b[1] for a, b in zip(told[::2], told[1::2], strict=True))
    events = [event for _, event in told[::2]]
    assert [type(event) for event in events] == [Started, StepDone, Message, StepDone, StepDone]
    assert events[0] == Started(0, 3)
    assert events[2] == Message("step 2: something")


def test_the_mean_psnr_is_over_the_last_steps() -> None:
    loop = looped(Counting(), 60)
    assert loop.mean_psnr is None
    loop.run()
    assert loop.mean_psnr == pytest.approx(20.0)  # images are off by 0.1


def test_it_stops_between_two_steps() -> None:
    trainer = Counting()
    loop = looped(trainer, 9)
    loop.run(lambda: trainer.done >= 4)
    assert trainer.done == 4
    loop.run()
    assert trainer.done == 9


def test_a_pause_is_no_training_time_and_ends_with_a_signal() -> None:
    pauses: list[float] = []
    answers = iter([True, True, True, False])
    is_stopped = False

    def listen(event: Event) -> None:
        nonlocal is_stopped
        if isinstance(event, Paused):
            pauses.append(event.seconds)
        if isinstance(event, StepDone) and event.step == 1:
            before = event.loop.stopwatch.seconds
            event.loop.pause(lambda: next(answers))
            assert event.loop.stopwatch.seconds - before < pauses[0]
        if isinstance(event, StepDone) and event.step == 2:
            is_stopped = True
            event.loop.pause(lambda: True)

    trainer = Counting()
    looped(trainer, 9, listen).run(lambda: is_stopped)
    assert trainer.done == 2
    assert 0.03 <= pauses[0] < 5


def test_advice_is_added_to_a_failing_step() -> None:
    """Advice is requested only when a step fails."""
    asked = []

    def advice() -> str:
        asked.append(trainer.done)
        return "Go on from there"

    told: list[Event] = []
    trainer = Counting(failures={3: "step 3: the loss is nan"})
    with pytest.raises(DyngsError, match=r"^step 3: the loss is nan\. Go on from there$"):
        looped(trainer, 5, told.append, advice=advice).run()
    assert asked == [2]
    assert [event.step for event in told if isinstance(event, StepDone)] == [1, 2]
    with pytest.raises(DyngsError, match=r"^step 3: the loss is nan$"):
        looped(trainer, 5).run()


@pytest.mark.parametrize("which", SIGNALS)
def test_a_signal_is_only_noted(which: signal.Signals, request: pytest.FixtureRequest) -> None:
    # nohup pytest: SIGHUP is ignored, as in programs that it starts
    request.addfinalizer(partial(signal.signal, which, signal.getsignal(which)))
    before = signal.default_int_handler if which is signal.SIGINT else signal.SIG_DFL
    signal.signal(which, before)
    with Interrupts() as interrupts:
        assert not interrupts.requested
        signal.raise_signal(which)
        assert interrupts.requested
    assert signal.getsignal(which) is before


def test_a_second_ctrl_c_insists() -> None:
    with Interrupts() as interrupts:
        signal.raise_signal(signal.SIGINT)
        assert interrupts.requested
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no signal of a closed terminal")
def test_nohup_is_respected() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupts() as interrupts:
            signal.raise_signal(signal.SIGHUP)
            assert not interrupts.requested
    finally:
        signal.signal(signal.SIGHUP, before)
