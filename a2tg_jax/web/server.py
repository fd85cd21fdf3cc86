"""Server of a page and its files from memory; runs on waitress.

It listens on the loopback, or, if asked, on a network. There it answers only below a random path, the token: whoever
has the address has access.
"""

import contextlib
import dataclasses
import importlib
import ipaddress
import secrets
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from typing import Any

from a2tg_jax.host import signals
from a2tg_jax.host.operating_system import allow_recent_port

LOOPBACK, ANY = "127.0.0.1", "0.0.0.0"
ELSEWHERE = "192.0.2.1"
"""Address that no machine has (RFC 5737)."""
HEADERS = (
    ("Cache-Control", "no-store"),
    ("Content-Security-Policy", "frame-ancestors 'none'"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Referrer-Policy", "no-referrer"),
    ("X-Content-Type-Options", "nosniff"),
)

StartResponse = Callable[[str, list[tuple[str, str]]], Any]
Application = Callable[[Mapping[str, Any], StartResponse], Iterable[bytes]]


@dataclasses.dataclass(frozen=True)
class Route:
    """Answer at a path."""

    content_type: str
    content: bytes | Callable[[], bytes | None]
    """Bytes, or a function that finds them at each request and returns None if there are none."""

    act: Callable[[], None] | None = None
    """Function called first. Such a path answers POST, from the page itself."""

    def read(self) -> bytes | None:
        return self.content() if callable(self.content) else self.content


@dataclasses.dataclass(frozen=True)
class Door:
    """Address at which a server listens, and the token that lets requests in."""

    name: str = LOOPBACK
    """Name or address by which the server was asked to listen."""
    address: str = LOOPBACK
    """IPv4 address at which it listens; 0.0.0.0 for all of this machine."""
    port: int = 0
    token: str = ""
    """First part of every path; empty for none."""

    @staticmethod
    def of(listening: socket.socket, name: str) -> "Door":
        """Return the door of a bound socket, with a new token if other machines can reach it."""
        address, port = listening.getsockname()
        return Door(name.lower(), address, port, "" if _is_loopback(address) else secrets.token_urlsafe(16))

    @property
    def url(self) -> str:
        """Address that opens the page."""
        host = lan_address() if self.address == ANY else self.name
        return f"http://{host}:{self.port}/{self.token}/" if self.token else f"http://{host}:{self.port}/"

    def admits(self, host: str) -> bool:
        """Return whether `host`, such as 127.0.0.1:8000, names this server, and not by a name that others chose."""
        name, _, port = host.rpartition(":")
        is_own = name in (self.name, self.address, LOOPBACK, "localhost")
        return port == str(self.port) and (is_own or (self.address == ANY and _is_ip(name)))

    def behind(self, path: str) -> str | None:
        """Return the path behind the token; None if the path has another token or none."""
        if not self.token:
            return path
        token, slash, rest = path.removeprefix("/").partition("/")
        return f"/{rest}" if slash and secrets.compare_digest(token.encode(), self.token.encode()) else None


def lan_address() -> str:
    """Return the IPv4 address by which the network reaches this machine; the loopback if there is no network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((ELSEWHERE, 9))  # Chooses an interface and sends nothing.
        except OSError:
            return LOOPBACK
        return str(probe.getsockname()[0])


def _is_ip(name: str) -> bool:
    try:
        ipaddress.IPv4Address(name)
    except ValueError:
        return False
    return True


def _is_loopback(address: str) -> bool:
    return ipaddress.IPv4Address(address).is_loopback


def application(routes: Mapping[str, Route], door: Door) -> Application:
    """Answer GET and HEAD, or POST, at the paths of `routes`, such as "/", and nothing else.

    A request must name this machine as the host that it asks, and begin its path with the door's token. A page from
    elsewhere, whose name is made to lead here, cannot read the scene.
    """

    def answer(environ: Mapping[str, Any], start_response: StartResponse) -> Iterable[bytes]:
        def refuse(status: str) -> list[bytes]:
            start_response(status, [("Content-Type", "text/plain"), *HEADERS])
            return [status.encode()]

        path = door.behind(environ["PATH_INFO"] or "/")
        if path is None or not door.admits(environ.get("HTTP_HOST") or ""):
            return refuse("403 Forbidden")
        route = routes.get(path)
        is_action = route is not None and route.act is not None
        if environ["REQUEST_METHOD"] not in (("POST",) if is_action else ("GET", "HEAD")):
            return refuse("405 Method Not Allowed")
        if route is not None and route.act is not None:
            if environ.get("HTTP_ORIGIN") != f"http://{environ['HTTP_HOST']}":
                return refuse("403 Forbidden")
            route.act()
        body = None if route is None else route.read()
        if route is None or body is None:
            return refuse("404 Not Found")
        start_response("200 OK", [("Content-Type", route.content_type), ("Content-Length", str(len(body))), *HEADERS])
        return [] if environ["REQUEST_METHOD"] == "HEAD" else [body]

    return answer


def serve(
    routes: Mapping[str, Route], *, host: str = LOOPBACK, port: int = 0, on_start: Callable[[str], None] = print
) -> None:
    """Serve until Ctrl-C, the usual end of a server.

    Args:
      routes: what is answered, by path.
      host: address to listen on; any but the loopback opens the server to the network, below a random path.
      port: on that address; 0 is a free one.
      on_start: called with the address once it answers.

    Raises:
      ValueError: if waitress is not installed, the port is taken, or this machine has no such address.
      Stopped: if the process is asked to end otherwise (`signals.raised`).
    """
    with _running(routes, host, port) as (url, ended):  # In a thread, for waitress hides how its loop was ended.
        try:
            on_start(url)
            while not ended.done():
                time.sleep(1)
            ended.result()
        except signals.Stopped:
            raise
        except KeyboardInterrupt:
            return


@contextlib.contextmanager
def served(routes: Mapping[str, Route], *, host: str = LOOPBACK, port: int = 0) -> Iterator[str]:
    """Serve in a thread within the block, and yield the address. Arguments and errors are those of `serve`.

    An error that ends the server is a warning at the end of the block.
    """
    with _running(routes, host, port) as (url, ended):
        yield url
    if error := ended.exception():
        warnings.warn(f"the viewer's server ended early: {error}", stacklevel=3)


@contextlib.contextmanager
def _running(routes: Mapping[str, Route], host: str, port: int) -> Iterator[tuple[str, Future[None]]]:
    """Yield the address of a server in a thread, and what tells its end and the error that ended it."""
    connections: dict[int, Any] = {}
    server, url = _opened(routes, host, port, connections)
    ended: Future[None] = Future()

    def run() -> None:
        try:
            server.run()
            ended.set_result(None)
        except BaseException as error:
            ended.set_exception(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield url, ended
    finally:
        # In the server's own thread, which ends when all is closed.
        server.trigger.pull_trigger(lambda: _close(connections))
        thread.join()
        _close(connections)  # If an error has ended the thread.
        server.task_dispatcher.shutdown()


def _close(connections: Mapping[int, Any]) -> None:
    for connection in list(connections.values()):
        connection.close()


def _opened(routes: Mapping[str, Route], host: str, port: int, connections: dict[int, Any]) -> tuple[Any, str]:
    """Return a server of waitress that listens, and answers once it is run, and the address of the page; the server
    keeps what it holds open in `connections`."""
    try:
        waitress: Any = importlib.import_module("waitress")
    except ImportError as error:
        raise ValueError("the viewer's server needs waitress: pip install 'a2tg-jax[viewer]'") from error
    listening = _listening(host, port)
    door = Door.of(listening, host)
    app = application(routes, door)
    return waitress.create_server(app, map=connections, sockets=[listening], threads=4, ident=None), door.url


def _listening(host: str, port: int) -> socket.socket:
    """Return a socket bound to a port of an address of this machine."""
    found = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        allow_recent_port(found)
        found.bind((host, port))
    except (OSError, OverflowError, UnicodeError) as error:
        found.close()
        reason = getattr(error, "strerror", None) or error
        place, remedy = f"port {port}", "leave out --port for a free one"
        if host != LOOPBACK:
            place, remedy = f"{host}:{port}", "--host takes an IPv4 address of this machine, or 0.0.0.0"
        raise ValueError(f"{place} cannot be used: {reason}; {remedy}") from error
    return found
