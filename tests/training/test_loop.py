"""The loop tells what happens in order, to every listener, whoever is trained."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from functools import partial

import pytest
from steps import Counting

from dyngs.core.errors import DyngsError
from dyngs.training.clock import Stopwatch
from dyngs.training.events import Event, Message, Started, StepDone, TotalChanged
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


def test_events_come_in_order_and_all_listeners_hear_them() -> None:
    """What was found in a step is told before that the step is done; listeners are told in the
    order they came in."""
    told: list[tuple[str, Event]] = []
    trainer = Counting(findings={2: "something"})
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


def test_a_listener_sees_every_step_as_it_is() -> None:
    seen = []

    def listener(event: Event) -> None:
        if isinstance(event, StepDone):
            seen.append(
                (event.step, event.is_last, event.total, event.num_gaussians, event.num_moving)
            )
            assert event.loop.trainer is trainer
            assert event.report.loss == 0.5
            trainer.num_gaussians += 1  # the next listener finds it so
            assert event.num_gaussians == trainer.num_gaussians
            assert event.bad_gradients == 0
            assert event.seconds >= 0

    trainer = Counting(done=4, num_gaussians=5, num_moving=2)
    looped(trainer, 7, listener).run()
    assert seen == [(5, False, 7, 5, 2), (6, False, 7, 6, 2), (7, True, 7, 7, 2)]


def test_a_listener_may_exchange_the_trainer() -> None:
    """From the next step on the other one is trained; listeners find it in the loop."""
    first = Counting(num_gaussians=5)
    second = Counting(done=10, num_gaussians=7)
    seen = []

    def exchanging(event: Event) -> None:
        if isinstance(event, StepDone) and event.step == 2:
            event.loop.trainer = second

    def seeing(event: Event) -> None:
        if isinstance(event, StepDone):
            seen.append((event.step, event.num_gaussians))

    looped(first, 12, exchanging, seeing).run()
    assert seen == [(1, 5), (2, 7), (11, 7), (12, 7)]
    assert (first.done, second.done) == (2, 12)


@pytest.mark.parametrize(("total", "steps"), [(2, 2), (5, 5)])
def test_another_number_of_steps_is_told_and_done(total: int, steps: int) -> None:
    told: list[Event] = []

    def listener(event: Event) -> None:
        told.append(event)
        if isinstance(event, StepDone) and event.step == 2:
            event.loop.expect(total)
            assert event.total == total
            assert event.is_last == (total == 2)

    trainer = Counting()
    looped(trainer, 3, listener).run()
    assert trainer.done == steps
    assert [event for event in told if isinstance(event, TotalChanged)] == [TotalChanged(total)]


def test_it_stops_between_two_steps() -> None:
    trainer = Counting()
    loop = looped(trainer, 9)
    loop.run(lambda: trainer.done >= 4)
    assert trainer.done == 4
    loop.run()
    assert trainer.done == 9


def test_nothing_is_done_after_the_end() -> None:
    told: list[Event] = []
    looped(Counting(done=3), 3, told.append).run()
    assert told == [Started(3, 3)]


def test_a_later_listener_hears_what_comes_later() -> None:
    told: list[Event] = []
    loop = looped(Counting(), 2)
    loop.tell(Message("before"))
    loop.subscribe(told.append)
    loop.tell(Message("after"))
    assert told == [Message("after")]


def test_advice_is_added_to_a_failing_step() -> None:
    """And is asked for only then."""
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


def test_the_watch_leaves_pauses_out() -> None:
    watch = Stopwatch()
    before = watch.seconds
    watch.pause(-1000)
    assert 1000 <= watch.seconds - before < 1060
    watch.pause(400)
    assert 600 <= watch.seconds - before < 660


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


def test_other_threads_may_train_too() -> None:
    seen = []

    def work() -> None:
        with Interrupts() as interrupts:
            seen.append(interrupts.requested)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]
