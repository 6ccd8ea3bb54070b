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
            try:
                name = urlsplit(f"//{host}").hostname or ""
            except ValueError:
                name = ""
            return None if is_loopback(name) else "only for requests to localhost"
        try:
            cookie = SimpleCookie(headers.get("Cookie", "")).get(COOKIE)
        except CookieError:
            cookie = None
        given = parse_qs(urlsplit(path).query).get("token", [])
        given = given if cookie is None else [*given, cookie.value]
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
    name = f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}/" + (f"?token={token}" if token else "")


def free_port(host: str, port: int | None) -> int:
    """Return the port to listen on: ``port``; None: 8080, or the next that is free. Raises
    DyngsError."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    for candidate in range(DEFAULT_PORT, DEFAULT_PORT + 50) if port is None else [port]:
        try:
            socket.create_server((host, candidate), family=family).close()
            return candidate
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise DyngsError(
                    f"--host {host}, port {candidate}: cannot listen there ({error.strerror or error})"
                ) from error
    raise DyngsError(
        f"--port {port or DEFAULT_PORT}: taken; choose another, or leave it out to get a free one"
    )


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
