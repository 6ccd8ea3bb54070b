"""Who may open the viewer's page: this machine alone, or whoever has the token of the link."""

from __future__ import annotations

import errno
import hmac
import http
import ipaddress
import secrets
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from dyngs.core.errors import DyngsError

DEFAULT_PORT = 8080
COOKIE = "dyngs_view"


@dataclass(frozen=True)
class Gate:
    """Decision on requests, of HTTP or of a websocket, by their paths with the query and their
    headers.

    Attributes:
        token: that a request has to bring, in the link or as the cookie that the link gives; None:
            requests must be addressed to this machine, so that pages of others cannot reach the
            viewer through a browser that runs here.
    """

    token: str | None = None

    def refusal(self, path: str, headers: Mapping[str, str]) -> str | None:
        """Return why a request is refused, or None."""
        host = headers.get("Host", "")
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return "a page of another site asks for it"
        if self.token is None:
            return None if is_loopback(_name_of(host)) else "only for requests to localhost"
        given = (*parse_qs(urlsplit(path).query).get("token", ()), _cookie(headers))
        if any(hmac.compare_digest(word.encode(), self.token.encode()) for word in given):
            return None
        return "the token is missing or wrong; open the link that `dyngs view` printed"

    def cookie(self, path: str) -> str | None:
        """Return the header ``Set-Cookie`` for a request that brings the token in the link; None:
        it needs none."""
        if self.token is None or "token" not in parse_qs(urlsplit(path).query):
            return None
        return f"{COOKIE}={self.token}; Path=/; HttpOnly; SameSite=Strict"


def gate_for(host: str) -> Gate:
    """Return the gate of a server on ``host``: with a new token unless that is this machine
    alone."""
    return Gate() if is_loopback(host) else Gate(secrets.token_urlsafe(24))


def is_loopback(host: str) -> bool:
    """Return whether a server on ``host`` can be reached from this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def link_to(host: str, port: int, token: str | None = None) -> str:
    """Return the address at which browsers find a server that listens on ``host`` and ``port``."""
    if host in ("0.0.0.0", "::"):
        host = socket.gethostname() or "localhost"
    elif host == "127.0.0.1":
        host = "localhost"
    return (
        f"http://{f'[{host}]' if ':' in host else host}:{port}/{f'?token={token}' if token else ''}"
    )


def free_port(host: str, port: int | None) -> int:
    """Return the port to listen on: ``port``; None: 8080, or the next that is free. Raises
    DyngsError."""
    for candidate in [port] if port is not None else [*range(DEFAULT_PORT, DEFAULT_PORT + 50), 0]:
        try:
            return _bound(host, candidate)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                if port is None:
                    continue
                raise port_taken(port) from error
            if error.errno == errno.EACCES:
                raise DyngsError(
                    f"--port {port}: not allowed for this user; choose one above 1023"
                ) from error
            raise DyngsError(
                f"--host {host}: cannot listen there ({error.strerror or error})"
            ) from error
    raise AssertionError("the last candidate is never taken")


def port_taken(port: int) -> DyngsError:
    """Return the error for a port that another program listens on."""
    return DyngsError(f"--port {port}: taken; choose another, or leave it out to get a free one")


@contextmanager
def guarded(gate: Gate) -> Iterator[None]:
    """Let the servers that viser starts meanwhile ask ``gate`` first: about pages and websockets
    alike.

    viser has no setting for this; it starts its server by ``websockets.asyncio.server.serve``.
    """
    from websockets.asyncio import server

    original = server.serve

    def serve(*args: Any, process_request: Any, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            refusal = gate.refusal(request.path, request.headers)
            if refusal is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"dyngs view: {refusal}\n")
            response = process_request(connection, request)
            cookie = gate.cookie(request.path)
            if response is not None and cookie is not None:
                response.headers["Set-Cookie"] = cookie
            return response

        return original(*args, process_request=checked, **options)

    server.serve = serve  # type: ignore[assignment]
    try:
        yield
    finally:
        server.serve = original


def _bound(host: str, port: int) -> int:
    """Return the port of a socket that could be bound. Raises OSError where it could not."""
    family, _, _, _, address = socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )[0]
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(address)
        return probe.getsockname()[1]


def _name_of(host: str) -> str:
    """Return the name in a header ``Host``, without its port."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


def _cookie(headers: Mapping[str, str]) -> str:
    try:
        found = SimpleCookie(headers.get("Cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return "" if found is None else found.value
