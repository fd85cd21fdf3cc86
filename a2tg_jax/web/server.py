"""Server of a page and its files from memory, for browsers of this machine alone; runs on waitress."""

import contextlib
import dataclasses
import importlib
import socket
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from a2tg_jax.host.operating_system import allow_recent_port

LOOPBACK = "127.0.0.1"
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


def application(routes: Mapping[str, Route], port: int) -> Application:
    """Answer GET and HEAD, or POST, at the paths of `routes`, such as "/", and nothing else.

    A request must name this machine as the host it asks: a page from elsewhere, whose name is made to lead here, cannot
    read the scene.
    """
    hosts = {f"{name}:{port}" for name in (LOOPBACK, "localhost")}

    def answer(environ: Mapping[str, Any], start_response: StartResponse) -> Iterable[bytes]:
        def refuse(status: str) -> list[bytes]:
            start_response(status, [("Content-Type", "text/plain"), *HEADERS])
            return [status.encode()]

        if environ.get("HTTP_HOST") not in hosts:
            return refuse("403 Forbidden")
        route = routes.get(environ["PATH_INFO"] or "/")
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


def serve(routes: Mapping[str, Route], *, port: int = 0, on_start: Callable[[str], None] = print) -> None:
    """Serve until the process is interrupted.

    Args:
      routes: what is answered, by path.
      port: on this machine; 0 is a free one.
      on_start: called with the address once it answers.

    Raises:
      ValueError: if waitress is not installed, or the port is taken.
    """
    server = _opened(routes, port, {})
    on_start(f"http://{LOOPBACK}:{server.effective_port}/")
    server.run()


@contextlib.contextmanager
def served(routes: Mapping[str, Route], *, port: int = 0) -> Iterator[str]:
    """Serve in a thread within the block, and yield the address. Arguments and errors are those of `serve`."""
    connections: dict[int, Any] = {}
    server = _opened(routes, port, connections)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        yield f"http://{LOOPBACK}:{server.effective_port}/"
    finally:
        # In the server's own thread, which ends when all is closed.
        server.trigger.pull_trigger(lambda: [connection.close() for connection in list(connections.values())])
        thread.join()
        server.task_dispatcher.shutdown()


def _opened(routes: Mapping[str, Route], port: int, connections: dict[int, Any]) -> Any:
    """Return a server of waitress that listens, and answers once it is run; it keeps what it holds open in
    `connections`."""
    try:
        waitress: Any = importlib.import_module("waitress")
    except ImportError as error:
        raise ValueError("the viewer's server needs waitress: pip install 'a2tg-jax[viewer]'") from error
    listening = _listening(port)
    app = application(routes, listening.getsockname()[1])
    return waitress.create_server(app, map=connections, sockets=[listening], threads=4, ident=None)


def _listening(port: int) -> socket.socket:
    """Return a socket bound to a port of the loopback."""
    found = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        allow_recent_port(found)
        found.bind((LOOPBACK, port))
    except (OSError, OverflowError) as error:
        found.close()
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"port {port} cannot be used: {reason}; leave out --port for a free one") from error
    return found
