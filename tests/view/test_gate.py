import socket
import urllib.error
import urllib.request

import pytest

from dyngs.core.errors import DyngsError
from dyngs.view.gate import COOKIE, Gate, free_port, gate_for, guarded, is_loopback, link_to


@pytest.mark.parametrize(
    "host", ["localhost:8080", "127.0.0.1:8080", "[::1]:8080", "LOCALHOST:9", "127.0.0.2:8080"]
)
def test_this_machine_may_open_the_page(host: str) -> None:
    assert Gate().refusal("/", {"Host": host}) is None
    assert Gate().refusal("/", {"Host": host, "Origin": f"http://{host}"}) is None


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example:8080"},  # a name that was made to point here
        # a page of others that opens a websocket
        {"Host": "localhost:8080", "Origin": "https://evil.example"},
        {"Host": "localhost:8080", "Origin": "null"},
        {},
    ],
)
def test_pages_of_others_may_not(headers: dict[str, str]) -> None:
    assert Gate().refusal("/", headers) is not None


def test_with_a_token_only_who_has_it_may() -> None:
    gate = Gate("secret")
    other = {"Host": "box:8080"}
    assert gate.refusal("/?token=secret", other) is None
    assert gate.refusal("/", other | {"Cookie": f"a=b; {COOKIE}=secret"}) is None
    for path, headers in (
        ("/", other),
        ("/?token=", other),
        ("/?token=wrong", other),
        ("/?token=s\u00e9cret", other),
        ("/", other | {"Cookie": f"{COOKIE}=wrong"}),
        ("/?token=secret", other | {"Origin": "http://evil.example"}),
    ):
        assert gate.refusal(path, headers) is not None
    assert "HttpOnly" in (gate.cookie("/?token=secret") or "")
    assert gate.cookie("/") is None
    assert Gate().cookie("/?token=x") is None


def test_only_a_server_for_others_has_a_token() -> None:
    assert [is_loopback(host) for host in ("localhost", "127.0.0.1", "::1")] == [True] * 3
    assert [is_loopback(host) for host in ("0.0.0.0", "::", "192.168.1.7", "box")] == [False] * 4
    assert gate_for("127.0.0.1").token is None
    first = gate_for("0.0.0.0").token
    second = gate_for("0.0.0.0").token
    assert first is not None
    assert len(first) >= 24
    assert first != second


def test_a_free_port_is_found_and_a_taken_one_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        with pytest.raises(DyngsError, match=f"--port {taken}: taken"):
            free_port("127.0.0.1", taken)
        assert free_port("127.0.0.1", None) != taken
    assert free_port("127.0.0.1", taken) == taken
    with pytest.raises(DyngsError, match="--host"):
        free_port("203.0.113.7", None)
    with pytest.raises(DyngsError, match="--host"):
        free_port("no.such.host.invalid", None)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "localhost"])
def test_the_link_leads_to_the_server(host: str) -> None:
    viser = pytest.importorskip("viser", reason="viser is not installed")
    with guarded(gate_for(host)):
        server = viser.ViserServer(host=host, port=free_port(host, None), verbose=False)
    try:
        assert urllib.request.urlopen(link_to(host, server.get_port()), timeout=5).status == 200
    finally:
        server.stop()


def test_the_link_to_other_addresses() -> None:
    assert link_to("::1", 80) == "http://[::1]:80/"
    assert link_to("box", 80, "secret") == "http://box:80/?token=secret"
    assert link_to("0.0.0.0", 80, "secret").endswith(f"{socket.gethostname()}:80/?token=secret")


def test_the_server_asks_the_gate() -> None:
    viser = pytest.importorskip("viser", reason="viser is not installed")
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    with guarded(Gate("secret")):
        server = viser.ViserServer(
            host="127.0.0.1", port=free_port("127.0.0.1", None), verbose=False
        )
    try:
        page = f"http://127.0.0.1:{server.get_port()}/"
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(page, timeout=5)
        assert refused.value.code == 403
        answer = urllib.request.urlopen(f"{page}?token=secret", timeout=5)
        assert answer.status == 200
        cookie = answer.headers["Set-Cookie"].partition(";")[0]
        with pytest.raises(InvalidStatus):
            connect(page.replace("http", "ws"), subprotocols=[f"viser-v{viser.__version__}"])  # type: ignore[list-item]
        with connect(
            page.replace("http", "ws"),
            additional_headers={"Cookie": cookie},
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
        ) as socket_:
            assert socket_.recv(timeout=5)
    finally:
        server.stop()
