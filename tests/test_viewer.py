"""`a2tg view` and `a2tg export`: what is served, to whom, and what a page holds."""

import base64
import contextlib
import dataclasses
import hashlib
import html
import http.client
import importlib
import io
import ipaddress
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image
from run_folders import create_run
from small_files import taken_apart
from small_models import origin_of
from small_values import some_gaussians
from test_compact import textured

from a2tg_jax import A2tg, Origin, Similarity, save_compact, save_model, save_ply, synthetic_scene
from a2tg_jax.appearance import parts
from a2tg_jax.base.text import in_bytes
from a2tg_jax.cli.main import main
from a2tg_jax.results import page_export
from a2tg_jax.results.compression import loss_measures
from a2tg_jax.results.model_source import Source, open_source
from a2tg_jax.results.page_export import export_comparison, export_web
from a2tg_jax.results.record import RunRecord, SceneSource, write_record
from a2tg_jax.results.viewing import CameraPhotographs, routes_of
from a2tg_jax.web import server
from a2tg_jax.web.page import viewer_html, viewer_html_with
from a2tg_jax.web.server import Door, Route, application, lan_address, served


def ask(app, path="/", method="GET", host="127.0.0.1:80"):
    """Status, headers and body of an answer."""
    printed = []
    environ = {"REQUEST_METHOD": method, "PATH_INFO": path, "HTTP_HOST": host}
    body = b"".join(app(environ, lambda status, headers: printed.append((status, dict(headers)))))
    ((status, headers),) = printed
    return int(status[:3]), headers, body


# The server


APP = application(
    {"/": Route("text/html", b"page"), "/lazy": Route("x/y", lambda: b"late"), "/none": Route("x/y", lambda: None)},
    Door(port=80),
)


def test_known_paths_are_answered():
    status, headers, body = ask(APP)
    assert (status, body, headers["Content-Type"], headers["Content-Length"]) == (200, b"page", "text/html", "4")
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert ask(APP, "/lazy")[2] == b"late"
    status, headers, body = ask(APP, method="HEAD")
    assert (status, body, headers["Content-Length"]) == (200, b"", "4")


@pytest.mark.parametrize(
    ("status", "requests"),
    [
        (404, [{"path": p} for p in ("/none", "/../etc/passwd", "//", "/lazy/", "/%2e%2e/", "lazy", "/scene.a2tgz?x")]),
        (403, [{"host": h} for h in ("evil.example", "127.0.0.1", "127.0.0.1:81", "localhost:8080", "", None)]),
        (405, [{"method": method} for method in ("POST", "PUT", "DELETE", "OPTIONS")]),
        (200, [{"host": "localhost:80"}]),
    ],
)
def test_other_paths_hosts_and_methods_are_refused(status, requests):
    assert [ask(APP, **request)[0] for request in requests] == [status] * len(requests)


@contextlib.contextmanager
def connected(address, num=1):
    """Open connections to a server on the loopback."""
    port = int(address.rstrip("/").rpartition(":")[2])
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=20)) for _ in range(num)]


@pytest.mark.parametrize("header", ["Content-Length: 300000000", "Transfer-Encoding: chunked"])
def test_a_large_body_is_refused_before_it_is_read(header):
    chunk = b"1000\r\n" + bytes(0x1000) + b"\r\n"
    with served({"/": Route("text/plain", b"here")}) as address, connected(address) as (connection,):
        connection.sendall(f"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n{header}\r\n\r\n".encode())
        if "chunked" in header:  # Exactly as many bytes as are refused: those after them would reset the connection.
            connection.sendall(chunk * ((1 << 16) // len(chunk) + 1))
        assert connection.recv(100).startswith(b"HTTP/1.1 413 ")


def test_many_slow_connections_do_not_keep_the_page_from_answering():
    with served({"/": Route("text/plain", b"here")}) as address, connected(address, 200) as slow:
        for connection in slow:
            connection.sendall(b"GET / HT")
        with connected(address) as (other,):
            other.settimeout(5)
            other.sendall(f"GET / HTTP/1.0\r\nHost: {address.split('/')[2]}\r\n\r\n".encode())
            assert other.recv(100).startswith(b"HTTP/1.0 200 OK")


@pytest.mark.parametrize("is_dripping", [False, True])
def test_a_connection_without_a_whole_request_is_closed(monkeypatch, is_dripping):
    monkeypatch.setattr(server, "PATIENCE", 1)
    with served({"/": Route("text/plain", b"here")}) as address, connected(address) as (connection,):
        connection.settimeout(0.2)
        for _ in range(50):
            with contextlib.suppress(TimeoutError):
                if is_dripping:
                    connection.sendall(b"G")
                assert connection.recv(1) == b""
                return
        pytest.fail("the connection stays open")


def test_a_kept_connection_may_be_older_than_its_request(monkeypatch):
    monkeypatch.setattr(server, "PATIENCE", 2)
    with served({"/": Route("text/plain", b"here")}) as address, connected(address) as (connection,):
        request = f"GET / HTTP/1.1\r\nHost: {address.split('/')[2]}\r\n\r\n".encode()
        for _ in range(3):
            connection.sendall(request[:9])
            time.sleep(1.2)
            connection.sendall(request[9:])
            answer = b""
            while not answer.endswith(b"here"):
                received = connection.recv(1000)
                assert received, "closed"
                answer += received


# waitress leaves the temporary file of a dropped answer to the garbage collector.
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
def test_an_answer_that_nobody_reads_is_dropped(monkeypatch):
    """Four such answers would keep all threads of the server waiting."""
    monkeypatch.setattr(server, "PATIENCE", 1)
    large = {"/": Route("text/plain", bytes(1 << 25)), "/small": Route("text/plain", b"here")}
    with served(large) as address, connected(address, 4) as deaf:
        host = address.split("/")[2]
        for connection in deaf:
            connection.sendall(f"GET / HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        time.sleep(0.2)
        with connected(address) as (other,):
            other.sendall(f"GET /small HTTP/1.0\r\nHost: {host}\r\n\r\n".encode())
            assert other.recv(100).startswith(b"HTTP/1.0 200 OK")


def test_a_server_listens_on_the_loopback_alone():
    with served({"/": Route("text/plain", b"here")}) as address:
        port = int(address.rstrip("/").rpartition(":")[2])
        assert address == f"http://127.0.0.1:{port}/"
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        connection.request("GET", "/")
        answer = connection.getresponse()
        assert (answer.status, answer.read()) == (200, b"here")
        connection.request("GET", "/elsewhere")
        assert connection.getresponse().read() == b"404 Not Found"
        with pytest.raises(ValueError, match=f"port {port} cannot be used"), served({}, port=port):
            pass
    with pytest.raises(OSError):
        http.client.HTTPConnection("127.0.0.1", port, timeout=20).request("GET", "/")
    connection.close()


def network_app(door):
    """An application with an action, as others on the network reach it."""
    act = Route("x/y", b"done", act=lambda: None)
    return application({"/": Route("text/html", b"page"), "/scene": Route("x/y", b"here"), "/act": act}, door)


def test_on_a_network_nothing_is_told_without_the_token():
    app = network_app(Door("0.0.0.0", "0.0.0.0", 80, "secret"))
    for path in ("/", "", "/scene", "/secret", "/Secret/", "/secre/", "/secret2/scene", "//secret/"):
        assert [ask(app, path, method=method)[0] for method in ("GET", "POST")] == [403, 403], path


def test_on_a_network_the_token_opens_the_page_and_what_it_fetches():
    app = network_app(Door("0.0.0.0", "0.0.0.0", 80, "secret"))
    asked = {path: ask(app, path, host="192.168.1.7:80") for path in ("/secret/", "/secret/scene", "/secret/none")}
    assert {path: (status, body) for path, (status, _, body) in asked.items()} == {
        "/secret/": (200, b"page"),
        "/secret/scene": (200, b"here"),
        "/secret/none": (404, b"404 Not Found"),
    }
    assert asked["/secret/"][1]["Referrer-Policy"] == "no-referrer"
    assert ask(app, "/secret/../../etc/passwd")[0] == 404
    assert ask(app, "/secret/", method="POST")[0] == 405
    assert ask(app, "/secret/act", method="POST")[0] == 403, "no page of its own asks"


@pytest.mark.parametrize(
    ("name", "address", "let_in", "kept_out"),
    [
        (
            "0.0.0.0",
            "0.0.0.0",
            "192.168.1.7:80 localhost:80",
            "evil.example:80 192.168.1.7:81 192.168.1.7.evil.example:80",
        ),
        ("192.168.1.7", "192.168.1.7", "192.168.1.7:80", "192.168.1.8:80"),
        ("desk.local", "192.168.1.7", "desk.local:80 192.168.1.7:80", "evil.example:80"),
    ],
)
def test_on_a_network_requests_must_name_the_machine(name, address, let_in, kept_out):
    app = network_app(Door(name, address, 80, "secret"))
    assert {ask(app, "/secret/", host=host)[0] for host in let_in.split()} == {200}
    assert {ask(app, "/secret/", host=host)[0] for host in kept_out.split()} == {403}


def test_a_server_on_a_network_has_a_new_token_each_time(monkeypatch):
    monkeypatch.setattr("a2tg_jax.web.server.lan_address", lambda: "192.168.1.7")
    tokens = []
    for _ in range(2):
        with served({"/": Route("text/plain", b"here")}, host="0.0.0.0") as address:
            port, token = re.fullmatch(r"http://192\.168\.1\.7:(\d+)/([\w-]{20,})/", address).groups()
            for path, status in (("/", 403), (f"/{token}/", 200)):
                connection = http.client.HTTPConnection("127.0.0.1", int(port), timeout=20)
                connection.request("GET", path, headers={"Host": f"192.168.1.7:{port}"})
                assert connection.getresponse().status == status
                connection.close()
            tokens.append(token)
    assert tokens[0] != tokens[1]


def test_an_error_of_the_server_ends_the_command_but_no_training(monkeypatch, untouched_jax, tmp_path, capsys):
    waitress = pytest.importorskip("waitress")

    def fail(self):
        raise OSError("Bad file descriptor")

    monkeypatch.setattr(waitress.server.BaseWSGIServer, "run", fail)
    save_ply(tmp_path / "a.ply", some_gaussians())
    assert main(["view", str(tmp_path / "a.ply"), "--no-open"]) == 2
    assert "Bad file descriptor" in capsys.readouterr().err
    with pytest.warns(UserWarning, match="the viewer's server ended early: Bad file descriptor"), served({}):
        pass


def test_addresses_on_a_network(monkeypatch):
    ipaddress.IPv4Address(lan_address())

    class Unplugged(socket.socket):
        def connect(self, address):
            raise OSError("Network is unreachable")

    monkeypatch.setattr(socket, "socket", Unplugged)
    assert lan_address() == "127.0.0.1"


@pytest.mark.parametrize("host", ["203.0.113.77", "a..b", "::1"])
def test_hosts_that_are_not_this_machine_are_refused(host):
    with pytest.raises(ValueError, match=f"{host}:0 cannot be used: .* 0.0.0.0"), served({}, host=host):
        pass


def test_view_tells_the_address_for_a_phone(monkeypatch, tmp_path, capsys):
    save_ply(tmp_path / "a.ply", some_gaussians())
    asked = []
    monkeypatch.setattr(
        "a2tg_jax.cli.runs.serve", lambda routes, *, on_start, **rest: (asked.append(rest), on_start("http://x/t/"))
    )
    assert main(["view", str(tmp_path / "a.ply"), "--no-open", "--host", "0.0.0.0"]) == 0
    assert asked == [{"host": "0.0.0.0", "port": 0}]
    assert capsys.readouterr().out.startswith("http://x/t/ shows")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_ctrl_c_is_the_usual_end_of_a_server(monkeypatch, tmp_path, number, code):
    save_ply(tmp_path / "a.ply", some_gaussians())
    monkeypatch.setattr("a2tg_jax.cli.runs.ViewCommand._started", lambda *_: signal.raise_signal(number))
    assert main(["view", str(tmp_path / "a.ply")]) == code


def test_without_waitress_one_line_says_what_to_do(monkeypatch, tmp_path, capsys):
    save_ply(tmp_path / "a.ply", some_gaussians())
    true_import = importlib.import_module

    def missing(name, *rest):
        if name == "waitress":
            raise ImportError(name)
        return true_import(name, *rest)

    monkeypatch.setattr(importlib, "import_module", missing)
    assert main(["view", str(tmp_path / "a.ply"), "--no-open"]) == 2
    needed = "the viewer's server needs waitress, which is not installed: pip install 'a2tg-jax[viewer]'"
    assert capsys.readouterr().err == f"a2tg: error: {needed}\n"


# The page


def test_the_policy_allows_the_page_its_own_script_and_style_and_nothing_else():
    text = viewer_html()
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)
    assert policy is not None and "default-src 'none'" in policy[1] and "unsafe" not in policy[1]

    def hashed(pattern):
        found = re.findall(pattern, text, re.DOTALL)
        assert len(found) == 1
        return "'sha256-" + base64.b64encode(hashlib.sha256(found[0].encode()).digest()).decode() + "'"

    assert f"script-src {hashed(r'<script[^>]*>(.*?)</script>')};" in policy[1]
    assert f"style-src {hashed(r'<style>(.*?)</style>')};" in policy[1]
    assert len(text) < 300_000 and not re.search(r"""(src|href)=["']?(https?:)?//""", text)


def test_the_page_and_the_renderer_have_kernels_of_the_same_numbers():
    found = re.search(r"const float OFFSET = ([\d.]+), LARGEST_LOG_EXPONENT = ([\d.]+),", viewer_html())
    assert found is not None
    assert tuple(map(float, found.groups())) == (parts.OFFSET, 1.0)


def test_a_page_holds_a_scene():
    text = viewer_html_with(b"\x00<script>\xff")
    assert text.count("<script") == viewer_html().count("<script") + 1
    data = re.search(r'<script type="text/plain" id="scene-data">([A-Za-z0-9+/=]*)</script>', text)
    assert data is not None and base64.b64decode(data[1]) == b"\x00<script>\xff"


# What is shown


def test_models_compact_scenes_and_point_clouds_are_opened(tmp_path):
    model = textured()
    save_model(tmp_path / "a.npz", model)
    save_compact(tmp_path / "b.a2tgz", model)
    save_ply(tmp_path / "c.ply", some_gaussians())
    for name, num in (("a.npz", model.num), ("b.a2tgz", model.num), ("c.ply", some_gaussians().num)):
        source = open_source(tmp_path / name)
        assert source.model.num == num and source.title == name[0] and not source.note
        assert taken_apart(source.encoded)[0]["page"]["title"] == name[0]


def test_3d_gaussians_are_said_to_be_shown_flat(tmp_path):
    path = tmp_path / "thick.ply"
    save_ply(path, some_gaussians())
    data = path.read_bytes().replace(b"SplatRenderMode: 2dgs", b"SplatRenderMode: default")
    head, end, body = data.partition(b"end_header\n")
    names = re.findall(rb"property float (\w+)", head)
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names)).copy()
    rows[:, names.index(b"scale_2")] = rows[:, names.index(b"scale_0")]
    path.write_bytes(head + end + rows.tobytes())
    with pytest.warns(UserWarning, match="thinnest axis is dropped"):
        source = open_source(path)
    assert "3D Gaussians" in source.note and str(path) not in source.note
    assert taken_apart(source.encoded)[0]["page"]["note"] == source.note


@pytest.mark.parametrize("name", ["nowhere.npz", "nowhere.a2tgz", "nowhere.ply", "nowhere"])
def test_missing_files(tmp_path, capsys, name):
    assert main(["view", str(tmp_path / name), "--no-open"]) == 2
    assert "nowhere" in capsys.readouterr().err


def test_a_model_is_chosen_in_run_folders_only(tmp_path, capsys):
    save_ply(tmp_path / "c.ply", some_gaussians())
    assert main(["view", str(tmp_path / "c.ply"), "--no-open", "--model", "a2tg-textures"]) == 2
    assert "is not a folder" in capsys.readouterr().err


def test_a_model_that_knows_no_scene_has_no_photographs():
    routes = routes_of(Source(textured(), "a"))
    assert json.loads(routes["/photographs.json"].read()) == []
    assert routes["/photographs/0.jpg"].read() is None


# Export


def test_a_folder_and_a_single_file(tmp_path):
    scene = synthetic_scene(num_views=4, width=24, height=16, num_points=20)
    source = Source(dataclasses.replace(textured(), origin=origin_of(scene)), "a")
    text = export_web(source, tmp_path / "site")
    page = tmp_path / "site" / "index.html"
    assert page.read_text(encoding="utf-8") == viewer_html(is_exported=True) != viewer_html()
    scene = (tmp_path / "site" / "scene.a2tgz").read_bytes()
    assert f"whose scene takes {in_bytes(len(scene))}, " in text and "dB of PSNR lost, for a model of 30 dB" in text
    assert taken_apart(scene)[0]["num"] == source.model.num
    total = sum(file.stat().st_size for file in page.parent.iterdir())
    assert text.endswith(f"{page}: {in_bytes(total)} with 2 files next to it")
    assert (tmp_path / "site" / "photographs.json").read_bytes() == b"[]"
    one = tmp_path / "one.html"
    for _ in range(2):  # The second time, it replaces the first.
        text = export_web(source, one, overwrite=True)
    assert text.endswith(f"one.html: {in_bytes(one.stat().st_size)}")
    assert one.read_text(encoding="utf-8") == viewer_html_with(scene)
    with pytest.raises(ValueError, match="no photographs"):
        export_web(source, tmp_path / "with", photographs=True)
    with pytest.raises(ValueError, match="leave out `single_file`"):
        export_web(source, tmp_path / "with.html", photographs=True)


def test_an_export_deletes_what_a_killed_one_left(tmp_path):
    """A web folder is uploaded as it is."""
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    site = tmp_path / "site"
    (site / "photographs").mkdir(parents=True)
    names = [".index.html", ".scene.a2tgz", ".photographs.json", "photographs/.7.jpg"]
    left = [site / f"{name}.{ended.pid}.partial" for name in names]
    others = [site / f".notes.txt.{ended.pid}.partial", site / f".index.html.{os.getppid()}.partial"]
    for path in (*left, *others):
        path.touch()
    export_web(Source(textured(), "a"), site)
    assert not any(path.exists() for path in left) and all(path.exists() for path in others)


def test_a_page_compares_two_models_of_one_scene(tmp_path):
    """Its frames hold both pages as they are, and titles are text."""
    page = tmp_path / "c.html"
    files = [Source(textured(), "a", path=tmp_path / name / "m.npz") for name in "xy"]
    assert f"{files[0].path} against {files[1].path}" in export_comparison(files, page)
    sources = [Source(textured(), "a", path=tmp_path / name / "models" / "<b>.npz") for name in "xy"]
    assert "x · <b> against y · <b>" in export_comparison(sources, page, overwrite=True)
    text = page.read_text(encoding="utf-8")
    frames = re.findall(r'<iframe title="([^"]*)" srcdoc="([^"]*)">', text)
    assert [html.unescape(title) for title, _ in frames] == ["x · <b>", "y · <b>"] and "<b>" not in text
    wanted = [viewer_html_with(source.encoded) for source in sources]
    assert [html.unescape(inside) for _, inside in frames] == wanted
    with pytest.raises(FileExistsError, match="add `overwrite`"):
        export_comparison(sources, page)
    with pytest.raises(ValueError, match=r"`out` must .* \.html; got .*c\.htm$"):
        export_comparison(sources, tmp_path / "c.htm")
    elsewhere = Origin.of_cameras([], transform=Similarity(2.0, np.eye(3), np.zeros(3)))
    moved = dataclasses.replace(sources[1], model=dataclasses.replace(textured(), origin=elsewhere))
    with pytest.raises(ValueError, match="are in different worlds"):
        export_comparison([sources[0], moved], page, overwrite=True)


def test_a_failed_export_leaves_the_photographs_of_the_old_page(tmp_path, monkeypatch):
    source = Source(textured(), "a")
    old = tmp_path / "photographs" / "0.jpg"
    export_web(source, tmp_path)
    old.parent.mkdir()
    old.touch()
    (tmp_path / "photographs.json").write_text("[0]")

    def full(path, data):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        patch.setattr(page_export, "write_whole", full)
        export_web(source, tmp_path, overwrite=True)
    assert old.is_file()
    export_web(source, tmp_path, overwrite=True)
    assert not old.parent.exists()


def test_a_page_of_someone_else_is_not_replaced(tmp_path):
    (tmp_path / "index.html").write_text("mine")
    with pytest.raises(ValueError, match="choose another folder"):
        export_web(Source(textured(), "a"), tmp_path)
    assert (tmp_path / "index.html").read_text() == "mine"


def test_photographs_are_those_of_the_cameras():
    scene = synthetic_scene(num_views=4, width=24, height=16, num_points=20)
    origin = origin_of(scene)
    photographs = CameraPhotographs(origin, lambda: scene)
    assert sorted(photographs.views) == [0, 1, 2, 3] and photographs.jpeg(9) is None
    found = np.asarray(Image.open(io.BytesIO(photographs.jpeg(0))), np.float32)
    by_name = {view.name: view for view in (*scene.train, *scene.test)}
    assert np.abs(found - by_name[origin.names[0]].image).mean() < 12


@pytest.mark.long
@pytest.mark.parametrize(
    ("error", "printed"),
    [(FileNotFoundError("no folder"), "photographs of"), (ValueError("a.png: is truncated"), r"a\.png: is truncated")],
)
def test_photographs_that_cannot_be_read_are_not_called_missing(
    tmp_path, monkeypatch, untouched_jax, capsys, error, printed
):
    """The viewer and the page go on without them, with a warning; what needs them tells the error."""

    def fail(self):
        raise error

    run = create_run(tmp_path / "run")
    scene = synthetic_scene(num_views=4, width=24, height=16, num_points=20)
    write_record(run, RunRecord(SceneSource("synthetic"), "a2tg", A2tg()))
    save_model(run.model("a2tg-textures"), dataclasses.replace(textured(), origin=origin_of(scene)))
    monkeypatch.setattr(SceneSource, "load", fail)
    source = open_source(run.path)
    assert main(["mesh", str(run.path), "--out", str(tmp_path / "a.glb"), "--texture", "photographs"]) == 2
    assert re.search(printed, capsys.readouterr().err)
    with pytest.raises(ValueError, match=printed):
        export_web(source, tmp_path / "site", photographs=True)
    is_told = isinstance(error, ValueError)
    warned = pytest.warns(UserWarning, match=printed) if is_told else contextlib.nullcontext()
    with warned:
        assert json.loads(routes_of(source)["/photographs.json"].read()) == []
    with warned:
        assert list(loss_measures(source.model, source.load_scene_or_warn(), source.settings)) == [
            "for a model of 30 dB"
        ]
