"""Scenes in object storage: the same as in a folder, in few requests, read ahead and again; and errors."""

import collections
import os
import re
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from small_values import assert_same
from test_data_colmap import write_scene as write_colmap
from test_data_transforms import write_blender, write_scene
from test_masks import NAMES, left_half, views_of, write_mask
from test_pictures import write_scene as write_photographs

from a2tg_jax import load_scene
from a2tg_jax.cli import main as cli
from a2tg_jax.data import photo_store
from a2tg_jax.host import remote_files
from a2tg_jax.host.regular_files import is_folder, is_regular, open_regular
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.record import SceneSource, read_record, scene_place
from a2tg_jax.training.batches import BatchOrder, PhotoStore

pytest.importorskip("upath")
import fsspec

ROOT = "/bucket/fox"
URL = "memory:/" + ROOT


class Store:
    """fsspec's file system in memory, with counted requests that can fail or take a while."""

    def __init__(self, monkeypatch):
        self.fs = fsspec.filesystem("memory")
        self.num, self.failing, self.seconds = collections.Counter(), [], 0.0
        for name in ("ls", "cat_file", "info"):
            monkeypatch.setattr(type(self.fs), name, self._counted(name, getattr(type(self.fs), name)))

    def _counted(self, name, ask):
        def asked(fs, path, *args, **kwargs):
            self.num[name, path] += 1
            time.sleep(self.seconds)
            if name == "cat_file" and self.failing:
                raise self.failing.pop()
            return ask(fs, path, *args, **kwargs)

        return asked

    def put(self, folder):
        """Replace what was there by what is in a folder."""
        if self.fs.exists(ROOT):
            self.fs.rm(ROOT, recursive=True)
        for file in folder.rglob("*"):
            if file.is_file():
                self.fs.pipe_file(f"{ROOT}/{file.relative_to(folder).as_posix()}", file.read_bytes())
        self.num.clear()

    def num_of(self, name):
        return sum(num for (asked, _), num in self.num.items() if asked == name)


@pytest.fixture
def store(monkeypatch):
    monkeypatch.setattr(remote_files, "PAUSES", (0.0, 0.0))
    monkeypatch.setattr(photo_store, "SHARE_OF_DISK", 0.0)
    made = Store(monkeypatch)
    yield made
    made.seconds = 0.0
    made.fs.rm("/bucket", recursive=True) if made.fs.exists("/bucket") else None


def write_masked(folder):
    """COLMAP's scene with masks, depth maps, and smaller images."""
    write_colmap(folder, models=("OPENCV",), text=True)
    (folder / "images").rename(folder / "images_2")
    (folder / "depths").mkdir()
    for name in NAMES:
        write_mask(folder / "masks_2" / f"{name}.png", left_half())
        np.save(folder / "depths" / name.replace(".png", ".npy"), np.ones((12, 16), np.float32))


def write_beside(folder):
    """A transforms.json with points, whose frames name files from "./"."""
    write_scene(folder)
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text.replace('"images/', '"./images/'))


KINDS = {
    "COLMAP": (write_colmap, {}),
    "COLMAP as text": (lambda folder: write_colmap(folder, text=True), {}),
    "COLMAP with masks": (write_masked, {"downscale": 2}),
    "undistorted": (lambda folder: write_colmap(folder, models=("RADIAL",)), {"downscale": 3}),
    "nerfstudio": (write_beside, {}),
    "Blender": (write_blender, {}),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_scene_is_that_of_the_folder(tmp_path, store, kind):
    """Folders are listed once, and photographs fetched once. Those without room are fetched again, and only those; at
    once, if there are no points."""
    write, options = KINDS[kind]
    folder = tmp_path / "fox"
    folder.mkdir()
    write(folder)
    store.put(folder)
    here, there = load_scene(folder, **options), load_scene(URL, room=0, **options)
    assert max(store.num.values()) == (2 if kind == "Blender" else 1) and store.num_of("info") == 0
    assert here.name == there.name == "fox"
    np.testing.assert_array_equal(here.points, there.points)
    for one, other in zip(views_of(here), views_of(there), strict=True):
        assert one.name == other.name and one.mask == other.mask
        assert_same(one.camera, other.camera)
        store.num.clear()
        np.testing.assert_array_equal(one.picture.read(), other.picture.read())
        assert store.num_of("cat_file") == sum(store.num.values()) == 1
        assert (one.depth is None) == (other.depth is None)
        if one.depth is not None:
            np.testing.assert_array_equal(one.depth.read(), other.depth.read())
    held = load_scene(URL, **options)
    store.num.clear()
    assert all(view.picture.read() is not None for view in views_of(held)) and not store.num


def load(room=0):
    return load_scene(URL, room=room)


@pytest.fixture(scope="module")
def distorted(tmp_path_factory):
    """A folder of the built-in scene, distorted."""
    return write_photographs(tmp_path_factory.mktemp("remote") / "fox", k1=0.05)


@pytest.fixture
def fox(distorted, store):
    """The built-in scene, distorted, in the store."""
    store.put(distorted)


@pytest.mark.parametrize("share", [0.0, 1e-12, 0.5])
def test_batches_are_of_the_same_bits_wherever_photographs_are(tmp_path, monkeypatch, fox, share):
    """Undistorted photographs fill a share of the disk; those beyond it are fetched and undistorted again."""
    monkeypatch.setattr(photo_store, "SHARE_OF_DISK", share)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(photo_store.shutil, "disk_usage", lambda folder: SimpleNamespace(free=3 * 38 * 30 * 3 * 10**12))
    scenes = load(), load(room=None)
    order = BatchOrder(scenes[0].train, 2, 0)
    assert sum(view.picture.is_remote for view in views_of(scenes[0])) == {0.0: 6, 1e-12: 3, 0.5: 0}[share]
    stores = [PhotoStore(scene.train, order, 4, room=0) for scene in scenes]
    for iteration in range(1, 5):
        (one, _), (other, _) = (each.batch(iteration) for each in stores)
        jax.tree.map(np.testing.assert_array_equal, one, other)
    for each in stores:
        each.close()


def test_interrupted_reads_are_repeated(fox, store):
    picture = load().train[0].picture
    store.failing = [ConnectionError("reset by peer"), TimeoutError()]
    with pytest.warns(UserWarning, match=r"fox/images/.*: (TimeoutError|ConnectionError: reset by peer); it is read"):
        picture.read()
    store.failing = [ConnectionError("reset by peer")] * 3
    with (
        pytest.warns(UserWarning, match="read again"),
        pytest.raises(OSError, match=r"png: cannot be read from its"),
    ):
        picture.read()
    store.failing = [PermissionError("AccessDenied")]
    with pytest.raises(OSError, match=r"\(PermissionError: AccessDenied\)"):
        picture.read()
    assert not store.failing


@pytest.mark.parametrize(("size", "num"), [(399, 2), (400, 2), (401, 3), (0, 0)])
def test_large_files_are_fetched_in_pieces(store, monkeypatch, size, num):
    monkeypatch.setattr(remote_files, "PIECE", 200)
    data = bytes(number % 251 for number in range(size))
    store.fs.pipe_file(f"{ROOT}/file", data)
    path = remote_files.located(f"{URL}/file")
    remote_files.check_reachable(path.parent)
    store.num.clear()
    with remote_files.fetched(path, 1000) as file:
        assert file.read() == data
    assert store.num_of("cat_file") == num == sum(store.num.values())


def listed_as(monkeypatch, **printed):
    """Change what the store lists about files."""
    ls = fsspec.filesystem("memory").ls
    listed = lambda fs, path, **options: [{**entry, **printed} for entry in ls(path, **options)]  # noqa: E731
    monkeypatch.setattr(type(fsspec.filesystem("memory")), "ls", listed)


@pytest.mark.parametrize("size", [None, 0, 7, 600])
def test_the_bound_of_a_file_holds_whatever_its_store_lists(store, monkeypatch, size):
    """No single request exceeds the bound either."""
    monkeypatch.setattr(remote_files, "PIECE", 200)
    store.fs.pipe_file(f"{ROOT}/file", bytes(500))
    listed_as(monkeypatch, size=size)
    path = remote_files.located(f"{URL}/file")
    remote_files.check_reachable(path.parent)
    with pytest.raises(ValueError, match=r"fox/file: has .*499"):
        open_regular(path, 499)
    with open_regular(path, 1000) as file:
        assert len(file.read()) == 500


def test_threads_that_need_the_same_folder_make_one_request(store):
    store.fs.pipe_file(f"{ROOT}/images/a.png", b"a")
    path = remote_files.located(URL)
    remote_files.check_reachable(path)
    store.seconds = 0.05
    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(is_folder, [path / "images"] * 4))
    assert store.num["ls", f"{ROOT}/images"] == 1


def test_links_are_followed(store, monkeypatch):
    for name in ("linked", "dangling"):
        store.fs.pipe_file(f"{ROOT}/{name}", bytes(5))
    listed_as(monkeypatch, type="link", size=1)
    path = remote_files.located(URL)
    remote_files.check_reachable(path)
    store.fs.rm(f"{ROOT}/dangling")
    assert is_regular(path / "linked") and remote_files.remote_entry(path / "linked").size == 5
    assert not is_regular(path / "dangling")


def test_folders_in_no_listing_are_not_requested(store):
    """A store may refuse to list a missing folder."""
    store.fs.pipe_file(f"{ROOT}/images/a.png", b"a")
    path = remote_files.located(URL)
    remote_files.check_reachable(path)
    store.num.clear()
    assert not is_folder(path / "sparse" / "0") and not store.num
    assert is_regular(path / "images" / "a.png") and store.num_of("ls") == 1
    assert not is_regular(path / "masks" / "a.png") and store.num_of("ls") == 1


def test_a_photograph_that_changes_or_goes_is_named(fox, store):
    first, second, *_ = load().train
    store.fs.copy(f"{ROOT}/images/{first.name.rpartition('/')[2]}", f"{ROOT}/images/{second.name.rpartition('/')[2]}")
    store.fs.rm(f"{ROOT}/images/{first.name.rpartition('/')[2]}")
    with pytest.raises(ValueError, match="has changed since the scene was loaded"):
        second.picture.read()
    with pytest.raises(ValueError, match="No such file or directory"):
        first.picture.read()


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*sparse points", "ignore:.*it is read again")
def test_a_run_that_loses_its_store_is_resumed(tmp_path, monkeypatch, capsys, fox, store):
    """The newest checkpoint stays. run.toml has the URL, which `--resume` and `a2tg info` take from there."""
    monkeypatch.setattr(cli, "configure_cpu", lambda: None)
    monkeypatch.setattr(photo_store, "SHARE_OF_MEMORY", 0.0)
    batch = PhotoStore.batch

    def lose(photographs, iteration):
        if iteration == 10:
            store.failing = [ConnectionError("network is unreachable")] * 100
        return batch(photographs, iteration)

    monkeypatch.setattr(PhotoStore, "batch", lose)
    out = tmp_path / "run"
    system = ("--system", "gaussians-2d-mcmc", "--stage1-iterations", "20", "--initial-gaussians", "40")
    assert cli.main(["train", f"{URL}/", "--out", str(out), *system, "--densify.cap", "40", "--quiet"]) == 2
    printed = capsys.readouterr().err.splitlines()[-1]
    assert "cannot be read from its store (ConnectionError: network is unreachable); " in printed
    assert "the last checkpoint is" in printed and "--resume" in printed
    assert read_record(RunFolder(out)).scene.path == URL
    store.failing = []
    monkeypatch.setattr(PhotoStore, "batch", batch)
    assert cli.main(["train", "--out", str(out), "--resume", "--quiet"]) == 0
    assert cli.main(["info", str(out)]) == 0
    assert f"scene    {URL} (downscale 1)" in capsys.readouterr().out


SECRETS = {
    "sftp://me:secret@host/fox": "sftp://me:…@host/fox",
    "memory://me:@host/fox": "memory://me:…@host/fox",
    "simplecache::sftp://me:secret@host/fox": "simplecache::sftp://me:…@host/fox",
    "zip://fox::sftp://me:se::cret@host/a.zip": "zip://fox::sftp://me:…@host/a.zip",
    "https://host/fox?sig=secret": "https://host/fox?…",
    "zip://fox::https://host/a.zip?sig=secret/x": "zip://fox::https://host/a.zip?…",
    "https://secret@host/fox": "https://…@host/fox",
}


@pytest.mark.parametrize("url", SECRETS)
def test_secrets_are_refused_and_not_printed(monkeypatch, capsys, url):
    for read in (load_scene, scene_place):
        with pytest.raises(ValueError, match=f"^{re.escape(SECRETS[url])}: has a password, token"):
            read(url)
    monkeypatch.setattr(cli, "configure_cpu", lambda: None)
    assert cli.main(["train", "fox", "--out", url]) == 2
    assert f"{SECRETS[url]}: only SCENE" in capsys.readouterr().err


def write_nothing_known(folder):
    (folder / "keyframes" / "cameras").mkdir(parents=True)
    (folder / "keyframes" / "cameras" / "1.json").write_text("{}")
    (folder / "cameras.xml").write_text("<document/>")


@pytest.mark.parametrize(
    ("url", "error", "message"),
    [
        (URL, FileNotFoundError, "memory://bucket/fox: has none of the scenes .* transforms_train.json; copy others"),
        ("memory://bucket/ox", FileNotFoundError, "memory://bucket/ox: no such scene folder, or it is empty"),
        (f"{URL}/transforms.json", FileNotFoundError, "No such file or directory: '.*transforms.json'"),
        (f"{URL}/cameras.xml", FileNotFoundError, "fox/cameras.xml: has none of the scenes"),
        ("nolibrary://bucket/fox", ValueError, "nolibrary://bucket/fox: nolibrary is needed$"),
        ("nos3fs://bucket/fox", ValueError, "nos3fs://bucket/fox: s3fs is needed: pip install s3fs$"),
        ("memory://[bucket", FileNotFoundError, r"memory://\[bucket: no such scene folder"),
        ("s3://", ValueError, "s3://: names no folder; write s3://bucket/scene"),
        ("file://scenes/fox", ValueError, "file://scenes/fox: is not a file on this machine; write file:///full/path"),
        (5, ValueError, "path must be a path, a URL, or a UPath of universal_pathlib; got 5"),
        (None, ValueError, "path must be .*; got None"),
        ("nothing://bucket/fox", ValueError, "nothing://bucket/fox: cannot be opened .*nothing"),
    ],
)
def test_what_cannot_be_read(tmp_path, monkeypatch, store, url, error, message):
    write_nothing_known(tmp_path / "fox")
    store.put(tmp_path / "fox")
    for name in ("nolibrary", "s3fs"):
        monkeypatch.setitem(sys.modules, name, None)
        scheme = f"no{name.removeprefix('no')}"
        fsspec.register_implementation(scheme, f"{name}.Files", errtxt=f"{name} is needed", clobber=True)
    with pytest.raises(error, match=message):
        load_scene(url)


def test_places_of_scenes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert scene_place("s3://bucket/fox/") == "s3://bucket/fox"
    assert scene_place("fox") == scene_place((tmp_path / "fox").as_uri()) == str((tmp_path / "fox").resolve())
    assert scene_place("FILE://localhost/a/fox") == os.path.realpath("/a/fox")
    for place in ("memory://data/fox/scene", "memory://data/fox/scene/transforms.json"):
        assert SceneSource(place).name == "fox/scene"
    assert SceneSource("memory://data/scene").name == "scene"


OTHERS = (
    "train fox --out=s3://b/run",
    "train memory://b/x --out memory://b/x",
    "train --config s3://b/run.toml --out run",
    "train --resume --out s3://b/run",
    "sfm s3://b/photos out",
)


@pytest.mark.parametrize("arguments", OTHERS)
def test_other_arguments_are_no_urls(monkeypatch, capsys, arguments):
    monkeypatch.setattr(cli, "configure_cpu", lambda: None)
    assert cli.main(arguments.split()) == 2
    assert "only SCENE of a2tg train may be a URL" in capsys.readouterr().err
