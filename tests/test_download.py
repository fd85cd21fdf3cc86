"""The data sets are fetched from a server of this machine, continued where they stopped, unpacked in their folder."""

import functools
import http.server
import threading
import zipfile

import download
import pytest


class Handler(http.server.SimpleHTTPRequestHandler):
    """Understands "Range: bytes=N-"."""

    def do_GET(self):
        content = (self.server.folder / self.path.lstrip("/")).read_bytes()
        first = int(self.headers.get("Range", "bytes=0-").removeprefix("bytes=").rstrip("-"))
        self.server.firsts.append(first)
        if first >= len(content):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(content)}")
            self.end_headers()
            return
        self.send_response(206 if first else 200)
        self.send_header("Content-Length", str(len(content) - first))
        self.end_headers()
        self.wfile.write(content[first:])

    def log_message(self, *args):
        pass


@pytest.fixture
def server(tmp_path):
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler)) as running:
        running.folder, running.firsts = tmp_path / "served", []
        running.folder.mkdir()
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def archive_of(server, members):
    with zipfile.ZipFile(server.folder / "set.zip", "w") as archive:
        for name, text in members.items():
            archive.writestr(name, text)
    return f"http://127.0.0.1:{server.server_address[1]}/set.zip"


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0], ids=["anew", "continued", "all but renamed"])
def test_archives_are_fetched_once_from_where_they_stopped(server, tmp_path, share):
    url, scenes = archive_of(server, {"garden/images/a.jpg": "a" * 5_000, "garden/b.txt": "b"}), tmp_path / "scenes"
    content = (server.folder / "set.zip").read_bytes()
    have = round(share * len(content))
    if have:
        (scenes / "archives").mkdir(parents=True)
        (scenes / "archives" / "set.partial").write_bytes(content[:have])
    download.fetch_all(scenes, {url: "360_v2"})
    assert (scenes / "360_v2/garden/images/a.jpg").read_text() == "a" * 5_000 and server.firsts == [have]
    download.fetch_all(scenes, {url: "360_v2"})
    assert server.firsts == [have], "what is there is left alone"
    assert [path.name for path in (scenes / "archives").iterdir()] == ["set.unpacked"]


def test_what_is_damaged_is_deleted_and_said(server, tmp_path):
    url, scenes = archive_of(server, {"garden/a.txt": "a"}), tmp_path / "scenes"
    (scenes / "archives").mkdir(parents=True)
    (scenes / "archives" / "set.partial").write_bytes(bytes(10_000))
    with pytest.raises(OSError, match="more bytes"):
        download.fetch_all(scenes, {url: "set"})
    (scenes / "archives" / "set.zip").write_bytes(b"no archive")
    with pytest.raises(ValueError, match="damaged, and was deleted"):
        download.fetch_all(scenes, {url: "set"})
    download.fetch_all(scenes, {url: "set"})
    assert (scenes / "set/garden/a.txt").is_file()


def test_nothing_is_written_outside_the_folder(server, tmp_path):
    url = archive_of(server, {"../outside.txt": "x"})
    with pytest.raises(ValueError, match="outside"):
        download.fetch_all(tmp_path / "scenes", {url: "set"})
    assert not (tmp_path / "scenes/outside.txt").exists()


def test_what_is_not_there_is_an_error(tmp_path):
    with pytest.raises(OSError):
        download.download("http://127.0.0.1:9/set.zip", tmp_path / "set.zip")
