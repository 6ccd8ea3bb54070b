"""The first Ctrl-C is a request, the second one insists, and handlers are put back."""

from __future__ import annotations

import signal
import threading

import pytest

from dyngs.training.interrupt import Interrupts


@pytest.mark.parametrize("which", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_only_noted(which: signal.Signals) -> None:
    before = signal.getsignal(which)
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


def test_other_threads_may_train_too() -> None:
    seen = []

    def work() -> None:
        with Interrupts() as interrupts:
            seen.append(interrupts.requested)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]
