"""The data sets are fetched from a server of this machine, continued where they stopped, unpacked in their folder."""

import functools
import hashlib
import http.server
import io
import tarfile
import threading
import zipfile

import pytest

from a2tg_jax.cli import main as cli
from a2tg_jax.data import download
from a2tg_jax.data.download import BENCHMARK_SETS, Archive


class Handler(http.server.SimpleHTTPRequestHandler):
    """Understands "Range: bytes=N-" with If-Range. Breaks a connection after `server.breaks_after` bytes, if set."""

    def do_GET(self):
        content = (self.server.folder / self.path.lstrip("/")).read_bytes()
        first = int(self.headers.get("Range", "bytes=0-").removeprefix("bytes=").rstrip("-"))
        if self.headers.get("If-Range", self.server.etag) != self.server.etag:
            first = 0
        self.server.firsts.append(first)
        if first >= len(content):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(content)}")
            self.end_headers()
            return
        self.send_response(206 if first else 200)
        self.send_header("Content-Length", str(len(content) - first))
        self.send_header("ETag", self.server.etag)
        self.end_headers()
        self.wfile.write(content[first:][: self.server.breaks_after])

    def log_message(self, *args):
        pass


@pytest.fixture
def server(tmp_path, monkeypatch):
    monkeypatch.setattr(download, "PAUSE_SECONDS", 0.0)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler)) as running:
        running.folder = tmp_path / "served"
        running.firsts = []
        running.breaks_after = None
        running.etag = '"1"'
        running.folder.mkdir()
        thread = threading.Thread(target=running.serve_forever, args=(0.01,))
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def archive_of(server, members, name="set.zip", **values):
    data = io.BytesIO()
    if name.endswith(".zip"):
        with zipfile.ZipFile(data, "w") as archive:
            for member, text in members.items():
                archive.writestr(member, text)
    else:
        with tarfile.open(fileobj=data, mode="w:gz") as packed:
            for member, text in members.items():
                info = tarfile.TarInfo(member)
                info.size = len(text)
                packed.addfile(info, io.BytesIO(text.encode()))
    (server.folder / name).write_bytes(data.getvalue())
    return Archive(f"http://127.0.0.1:{server.server_address[1]}/{name}", "360_v2", **values)


def fetch(archive, scenes):
    return download.fetch(archive, scenes, progress=False)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0], ids=["anew", "continued", "all but renamed"])
def test_archives_are_fetched_once_from_where_they_stopped(server, tmp_path, share):
    members = {"garden/images/a.jpg": "a" * 5_000, "garden/b.txt": "b", "__MACOSX/garden/._b.txt": "x"}
    archive = archive_of(server, members)
    scenes = tmp_path / "scenes"
    content = (server.folder / "set.zip").read_bytes()
    have = round(share * len(content))
    if have:
        (scenes / "archives").mkdir(parents=True)
        (scenes / "archives" / "set.zip.partial").write_bytes(content[:have])
    assert fetch(archive, scenes)
    assert (scenes / "360_v2/garden/images/a.jpg").read_text() == "a" * 5_000 and server.firsts == [have]
    assert not (scenes / "360_v2/__MACOSX").exists()
    assert not fetch(archive, scenes) and server.firsts == [have], "what is there is left alone"
    assert [path.name for path in (scenes / "archives").iterdir()] == ["set.zip.unpacked"]


def test_a_broken_connection_is_continued(server, tmp_path):
    archive = archive_of(server, {"a.txt": "a" * 5_000})
    server.breaks_after = 2_000
    fetch(archive, tmp_path / "scenes")
    assert server.firsts == [0, 2_000, 4_000] and (tmp_path / "scenes/360_v2/a.txt").read_text() == "a" * 5_000


def test_parts_of_two_versions_are_not_joined(server, tmp_path, monkeypatch):
    archive = archive_of(server, {"a.txt": "a" * 5_000})
    server.breaks_after = 500
    monkeypatch.setattr(download, "ATTEMPTS", 1)
    with pytest.raises(OSError, match="call again"):
        fetch(archive, tmp_path / "scenes")
    archive = archive_of(server, {"a.txt": "b" * 5_000})
    server.etag = '"2"'
    server.breaks_after = None
    fetch(archive, tmp_path / "scenes")
    assert server.firsts == [0, 0] and (tmp_path / "scenes/360_v2/a.txt").read_text() == "b" * 5_000


def test_a_wrong_checksum_is_an_error(server, tmp_path):
    archive = archive_of(server, {"a.txt": "a"}, sha256="0" * 64)
    with pytest.raises(ValueError, match=r"its SHA-256 is not 0+; the file was deleted"):
        fetch(archive, tmp_path / "scenes")
    assert not (tmp_path / "scenes/360_v2").exists() and not (tmp_path / "scenes/archives/set.zip").exists()
    right = hashlib.sha256((server.folder / "set.zip").read_bytes()).hexdigest()
    assert fetch(archive._replace(sha256=right), tmp_path / "scenes")


def test_what_is_damaged_is_deleted_and_said(server, tmp_path):
    archive = archive_of(server, {"garden/a.txt": "a"})
    scenes = tmp_path / "scenes"
    (scenes / "archives").mkdir(parents=True)
    (scenes / "archives" / "set.zip.partial").write_bytes(bytes(10_000))
    with pytest.raises(OSError, match="more bytes"):
        fetch(archive, scenes)
    (scenes / "archives" / "set.zip").write_bytes(b"no archive")
    with pytest.raises(ValueError, match="damaged, and was deleted"):
        fetch(archive, scenes)
    assert fetch(archive, scenes) and (scenes / "360_v2/garden/a.txt").is_file()


@pytest.mark.parametrize("name", ["set.zip", "set.tar.gz"])
def test_nothing_is_written_outside_the_folder(server, tmp_path, name):
    archive = archive_of(server, {"../outside.txt": "x"}, name)
    with pytest.raises(ValueError, match="outside"):
        fetch(archive, tmp_path / "scenes")
    assert not (tmp_path / "scenes/outside.txt").exists()


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE])
def test_links_in_archives_are_refused(server, tmp_path, kind):
    """Even Pythons without filters write nothing through a link, and the archive is not fetched again."""
    archive = archive_of(server, {}, "set.tar.gz")
    with tarfile.open(server.folder / "set.tar.gz", "w:gz") as packed:
        link = tarfile.TarInfo("garden")
        link.type = kind
        link.linkname = "../.."
        packed.addfile(link)
        packed.addfile(tarfile.TarInfo("garden/outside.txt"))
    for _ in range(2):
        with pytest.raises(ValueError, match="the member 'garden' is a link or a device, which may lead outside"):
            fetch(archive, tmp_path / "scenes")
    assert server.firsts == [0] and not list((tmp_path / "scenes/360_v2").iterdir())


def test_what_came_from_elsewhere_is_not_overwritten(server, tmp_path):
    archive = archive_of(server, {"garden/": "", "garden/a.txt": "new"})
    own = tmp_path / "scenes/360_v2/garden/a.txt"
    own.parent.mkdir(parents=True)
    own.write_text("my own")
    for _ in range(2):
        with pytest.raises(
            FileExistsError, match=r"a\.txt: exists already and differs from the one in set\.zip; move it"
        ):
            fetch(archive, tmp_path / "scenes")
    assert own.read_text() == "my own" and server.firsts == [0]
    (tmp_path / "scenes/archives/set.zip.unpacking").touch()  # As an unpacking leaves it that was interrupted.
    assert fetch(archive, tmp_path / "scenes") and own.read_text() == "new"


def test_room_on_the_disk_is_checked_first(server, tmp_path):
    archive = archive_of(server, {"a.txt": "a"}, num_bytes=10**18)
    with pytest.raises(OSError, match=r"needs 2000000000\.0 GB of disk in .* make room, or choose another folder"):
        fetch(archive, tmp_path / "scenes")
    assert server.firsts == []


def test_the_command_lists_and_fetches(server, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(BENCHMARK_SETS, "tiny", archive_of(server, {"a.txt": "a"}, content="a text"))
    assert cli.main(["download", "--list"]) == 0
    printed = capsys.readouterr().out
    assert all(f"{name} " in printed for name in BENCHMARK_SETS)
    assert cli.main(["download", "tiny", "--out", str(tmp_path / "scenes")]) == 0
    assert (tmp_path / "scenes/360_v2/a.txt").is_file() and "tiny: unpacked in" in capsys.readouterr().out
    assert cli.main(["download", "mipnerf", "--out", str(tmp_path / "scenes")]) == 2
    assert "did you mean mipnerf360" in capsys.readouterr().err
