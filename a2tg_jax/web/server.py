"""Server of a page and its files from memory, on waitress.

It listens on the loopback, or on a network. There it answers only below a random path, the token: the address grants
access.
"""

import contextlib
import dataclasses
import ipaddress
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from typing import Any

from a2tg_jax.base.user_warnings import warn
from a2tg_jax.host import signals
from a2tg_jax.host.optional import optional

LOOPBACK = "127.0.0.1"
ANY = "0.0.0.0"
ELSEWHERE = "192.0.2.1"
"""Address that no machine has (RFC 5737)."""
MOST_BODY_BYTES = 1 << 16
"""Bytes of a request's body from which it is refused; the page sends none. waitress would keep larger ones on disk."""
MOST_CONNECTIONS = 500
"""Open connections; further ones wait."""
PATIENCE = 10
"""Seconds in which a request must be complete, and without progress after which a connection is closed."""
# Other sites can neither frame the page nor read the scene; browsers keep no copy of a changing one.
HEADERS = (
    ("Cache-Control", "no-store"),
    ("Content-Security-Policy", "frame-ancestors 'none'"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Referrer-Policy", "no-referrer"),
    ("X-Content-Type-Options", "nosniff"),
)

Application = Callable[[Mapping[str, Any], Callable[[str, list[tuple[str, str]]], Any]], Iterable[bytes]]


@dataclasses.dataclass(frozen=True)
class Route:
    """Answer at a path."""

    content_type: str
    content: bytes | Callable[[], bytes | None]
    """Bytes, or a function that returns them for each request, None if there are none."""
    act: Callable[[], None] | None = None
    """Function called first. Such a path answers only POST requests from the page itself."""

    def read(self) -> bytes | None:
        return self.content() if callable(self.content) else self.content


@dataclasses.dataclass(frozen=True)
class Door:
    """Address of a server, and the token that requests need."""

    name: str = LOOPBACK
    """Name or address of this machine, as the user gave it."""
    address: str = LOOPBACK
    """IPv4 address to listen on; 0.0.0.0 for all of this machine's."""
    port: int = 0
    token: str = ""
    """First part of every path; empty for none."""

    @property
    def url(self) -> str:
        """Address that opens the page."""
        host = lan_address() if self.address == ANY else self.name
        return f"http://{host}:{self.port}/{self.token}/" if self.token else f"http://{host}:{self.port}/"

    def admits(self, host: str) -> bool:
        """Return whether `host`, such as 127.0.0.1:8000, names this server by a name that others cannot choose."""
        # DNS rebinding: a page elsewhere can let its own name lead to this address.
        name, _, port = host.rpartition(":")
        is_own = name in (self.name, self.address, LOOPBACK, "localhost")
        # An IPv4 address cannot be rebound; any of this machine's may be used.
        if self.address == ANY and not is_own:
            with contextlib.suppress(ValueError):
                ipaddress.IPv4Address(name)
                is_own = True
        return is_own and port == str(self.port)

    def behind(self, path: str) -> str | None:
        """Return the path after the token; None if the token is wrong or missing."""
        if not self.token:
            return path
        # Compared in constant time: the time of an answer must not reveal the token.
        token, slash, rest = path.removeprefix("/").partition("/")
        return f"/{rest}" if slash and secrets.compare_digest(token.encode(), self.token.encode()) else None


def lan_address() -> str:
    """Return this machine's IPv4 address in the network; the loopback without a network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((ELSEWHERE, 9))  # Chooses an interface and sends nothing.
        except OSError:
            return LOOPBACK
        return str(probe.getsockname()[0])


def application(routes: Mapping[str, Route], door: Door) -> Application:
    """Answer GET and HEAD, or POST, at the paths of `routes`, such as "/", and nothing else.

    A request must name this machine as its host, and its path must begin with the door's token. Pages of other sites
    cannot read the scene, even if their names resolve to this machine.
    """

    def answer(
        environ: Mapping[str, Any], start_response: Callable[[str, list[tuple[str, str]]], Any]
    ) -> Iterable[bytes]:
        def refuse(status: str) -> list[bytes]:
            start_response(status, [("Content-Type", "text/plain"), *HEADERS])
            return [status.encode()]

        path = door.behind(environ["PATH_INFO"] or "/")
        if path is None or not door.admits(environ.get("HTTP_HOST") or ""):
            return refuse("403 Forbidden")
        route = routes.get(path)
        method = environ["REQUEST_METHOD"]
        act = None if route is None else route.act
        if method not in (("GET", "HEAD") if act is None else ("POST",)):
            return refuse("405 Method Not Allowed")
        if act is not None:
            # Forms of other sites can POST here; only the page itself has this origin.
            if environ.get("HTTP_ORIGIN") != f"http://{environ['HTTP_HOST']}":
                return refuse("403 Forbidden")
            act()
        body = None if route is None else route.read()
        if route is None or body is None:
            return refuse("404 Not Found")
        start_response("200 OK", [("Content-Type", route.content_type), ("Content-Length", str(len(body))), *HEADERS])
        return [] if method == "HEAD" else [body]

    return answer


def serve(
    routes: Mapping[str, Route], *, host: str = LOOPBACK, port: int = 0, on_start: Callable[[str], None] = print
) -> None:
    """Serve until Ctrl-C, the usual end of a server.

    Args:
      routes: routes by path.
      host: address to listen on; any but the loopback opens the server to the network, below a random path.
      port: port number; 0 is a free one.
      on_start: function called with the URL once the server answers.

    Raises:
      ValueError: if waitress is not installed, the port is taken, or this machine has no such address.
      Stopped: if another signal ends the process (`signals.raised`).
    """
    with _running(routes, host, port) as (url, ended):  # In a thread: waitress hides how its loop ended.
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
    """Serve in a thread during the block, and yield the URL. Arguments and errors as in `serve`.

    An error that ends the server is a warning at the end of the block.
    """
    with _running(routes, host, port) as (url, ended):
        yield url
    if error := ended.exception():
        warn(f"the viewer's server ended early: {error}")


def close_stalled(channels: Iterable[Any], now: float) -> None:
    """Close waitress's channels without progress for `PATIENCE`, and those whose request takes longer to arrive.

    waitress itself keeps a connection whose request comes byte by byte, or whose answer is not read.
    """
    before = now - PATIENCE
    for channel in channels:
        is_idle = channel.last_activity < before and (not channel.requests or channel.total_outbufs_len > 0)
        # The channel may be older: a connection is kept for further requests.
        is_slow = channel.request is not None and vars(channel.request).setdefault("first_seen", now) < before
        if is_idle or is_slow:
            channel.will_close = True


@contextlib.contextmanager
def _running(routes: Mapping[str, Route], host: str, port: int) -> Iterator[tuple[str, Future[None]]]:
    """Yield the URL of a server in a thread, and a future for its end or the error that ended it."""
    waitress = optional("waitress", "the viewer's server needs waitress", "viewer")
    try:
        if not 0 <= port < 2**16:  # `create_server` would leave the socket open.
            raise OverflowError("ports are 0 to 65535")
        listening = socket.create_server((host, port))  # SO_REUSEADDR: a port freed a moment ago may be reused.
    except (OSError, OverflowError, UnicodeError) as error:
        place = f"port {port}"
        remedy = "leave out --port for a free one"
        if host != LOOPBACK:
            place = f"{host}:{port}"
            remedy = "--host takes an IPv4 address of this machine, or 0.0.0.0"
        raise ValueError(f"{place} cannot be used: {getattr(error, 'strerror', None) or error}; {remedy}") from error
    address, port = listening.getsockname()
    is_private = ipaddress.IPv4Address(address).is_loopback
    door = Door(host.lower(), address, port, "" if is_private else secrets.token_urlsafe(16))
    connections: dict[int, Any] = {}
    # An own socket map: waitress's default is global, and would mix servers of one process.
    server = waitress.create_server(
        application(routes, door), map=connections, sockets=[listening], threads=4, ident=None,
        max_request_body_size=MOST_BODY_BYTES, connection_limit=MOST_CONNECTIONS, cleanup_interval=1,
        asyncore_use_poll=True,  # select takes no more than 1,024 connections.
    )  # fmt: skip
    server.maintenance = lambda now: close_stalled(server.active_channels.values(), now)
    ended: Future[None] = Future()

    def run() -> None:
        try:
            server.run()
            ended.set_result(None)
        # SystemExit included: the future must end however the thread does.
        except BaseException as error:
            ended.set_exception(error)

    def close() -> None:
        for connection in list(connections.values()):
            connection.close()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield door.url, ended
    finally:
        server.trigger.pull_trigger(close)  # In the server's own thread, which ends when all is closed.
        thread.join()
        close()  # If an error has ended the thread.
        server.task_dispatcher.shutdown()
