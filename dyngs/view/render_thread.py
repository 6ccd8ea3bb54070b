"""The one thread that draws for all browsers: whoever waits longest is next, and gets the newest
state."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from contextvars import copy_context

from dyngs.core.errors import DyngsError
from dyngs.view.session import Session


class Drawer:
    """Sessions, and the turn of each; ``on_error`` is told what went wrong for one, the others go
    on."""

    def __init__(self, on_error: Callable[[Session, str], None]) -> None:
        self._on_error = on_error
        self._changed = threading.Condition()
        self._sessions: list[Session] = []
        self._thread: threading.Thread | None = None
        self._is_stopped = False
        self._failures: dict[Session, str] = {}

    @property
    def sessions(self) -> tuple[Session, ...]:
        with self._changed:
            return tuple(self._sessions)

    def add(self, session: Session) -> None:
        session.on_change = self._wake
        with self._changed:
            self._sessions.append(session)
            self._changed.notify_all()

    def remove(self, session: Session) -> None:
        session.close()
        self._failures.pop(session, None)
        with self._changed:
            if session in self._sessions:
                self._sessions.remove(session)
            self._changed.notify_all()

    def draw_one(self) -> bool:
        """Do what is due for one session; return whether anything was."""
        session, wait = self._next()
        if session is None or wait > 0:
            return False
        self._turn(session)
        return True

    def start(self) -> None:
        """Draw in a thread of its own."""
        self._thread = threading.Thread(
            target=copy_context().run, args=(self._run,), name="dyngs-view", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """End the thread, after the image that it is at."""
        with self._changed:
            self._is_stopped = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(timeout=10)

    def _run(self) -> None:
        while not self._is_stopped:
            session, wait = self._next()
            if session is not None and wait <= 0 and not self._is_stopped:
                self._turn(session)
                continue
            with self._changed:
                if not self._is_stopped:
                    self._changed.wait(wait)

    def _next(self) -> tuple[Session | None, float]:
        """Return the session that is due first, among equals that served longest ago, and when:
        within 0.5 s."""
        best: tuple[Session | None, float] = (None, 0.5)
        for session in self.sessions:
            wait = session.due()
            if wait is not None and wait < best[1]:
                best = (session, wait)
        return best

    def _turn(self, session: Session) -> None:
        with self._changed:
            if session in self._sessions:  # served: last in the row
                self._sessions.remove(session)
                self._sessions.append(session)
        try:
            session.draw_next()
        except DyngsError as error:
            self._fail(session, str(error))
        except Exception as error:  # a fault of one session must not end the images of all
            if self._fail(session, f"{type(error).__name__}: {error}"):
                traceback.print_exc()
        else:
            self._failures.pop(session, None)

    def _fail(self, session: Session, message: str) -> bool:
        """Say what went wrong, once in a row: what is played fails many times a second. Return
        whether it is new."""
        if session.closed or self._failures.get(session) == message:
            return False
        self._failures[session] = message
        self._on_error(session, message)
        return True

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()
