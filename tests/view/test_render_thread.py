import threading
import time

import pytest
from view_sessions import looking_at_balls

from dyngs.core.errors import DyngsError
from dyngs.view.render_thread import Drawer
from dyngs.view.session import Session


def test_each_gets_a_turn_and_the_thread_ends() -> None:
    before = threading.active_count()
    drawer = Drawer(lambda session, message: None)
    browsers = [looking_at_balls() for _ in range(3)]
    drawer.start()
    for session, _ in browsers:
        drawer.add(session)
        session.change_timeline(playing=True)
    until = time.monotonic() + 10
    while min(len(sent) for _, sent in browsers) < 3 and time.monotonic() < until:
        time.sleep(0.01)
    assert min(len(sent) for _, sent in browsers) >= 3
    drawer.remove(browsers[0][0])
    count = len(browsers[0][1])
    time.sleep(0.2)
    assert len(browsers[0][1]) <= count + 1  # the one that was being drawn
    drawer.stop()
    assert threading.active_count() == before


def test_a_fault_of_one_is_told_and_the_others_go_on() -> None:
    told: list[tuple[Session, str]] = []
    drawer = Drawer(lambda session, message: told.append((session, message)))
    (bad, _), (good, sent) = looking_at_balls(), looking_at_balls()

    def fail() -> None:
        raise DyngsError("no such file")

    drawer.add(bad)
    drawer.add(good)
    bad.ask(fail)
    for _ in range(6):
        drawer.draw_one()
    assert told == [(bad, "no such file")]
    assert sent


def test_what_fails_again_and_again_is_told_once(capsys: pytest.CaptureFixture[str]) -> None:
    told: list[str] = []
    drawer = Drawer(lambda session, message: told.append(message))
    session, sent = looking_at_balls()
    drawer.add(session)

    def fail() -> None:
        raise ZeroDivisionError("by nothing")

    for _ in range(50):
        session.ask(fail)
        drawer.draw_one()
    assert told == ["ZeroDivisionError: by nothing"]
    assert capsys.readouterr().err.count("Traceback") == 1
    assert drawer.draw_one()  # it goes on
    assert sent
