"""Photographs that do not fit into memory: the same bits from disk, read ahead, and named where they are gone."""

import copy
import dataclasses
import functools
import json
import pickle
import tempfile
import threading
import time

import jax
import numpy as np
import pytest
from PIL import Image
from small_values import assert_same
from test_data_transforms import write_points

from a2tg_jax import Gaussians2dMcmc, LossConfig, Mcmc, Picture, fit, load_scene, synthetic_scene
from a2tg_jax.data.photo_store import Shelf
from a2tg_jax.training import batches, loop
from a2tg_jax.training.batches import Ahead, BatchOrder, PhotoStore

SYSTEM = Gaussians2dMcmc(
    stage1_iterations=12, initial_gaussians=60, densify=Mcmc(cap=70), sh_degree=0, loss=LossConfig(ssim_weight=0.0)
)
KINDS = {
    "as in their files": {},
    "smaller": {"downscale": 2},
    "undistorted": {"k1": 0.05},
    "with opacity": {"alpha": True},
}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A separate folder for what goes to disk."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "a2tg-jax"


@functools.cache
def built_in():
    return synthetic_scene(num_views=6, width=40, height=32, num_points=100)


def write_scene(folder, *, alpha=False, **intrinsics):
    """The built-in scene as files; returns the folder."""
    frames = []
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for index, view in enumerate((*built_in().train, *built_in().test)):
        pixels = view.image
        if alpha:  # one picture of them is opaque
            opacity = np.full((*view.picture.size, 1), 255 if index == 1 else 100, np.uint8)
            pixels = np.concatenate([pixels, opacity], axis=2)
        Image.fromarray(pixels).save(folder / "images" / view.name)
        pose = np.linalg.inv(np.asarray(view.camera.viewmat, np.float64)) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{view.name}", "transform_matrix": pose.tolist()})
    K = np.asarray(built_in().train[0].camera.K, float)
    values = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], **intrinsics}
    (folder / "transforms.json").write_text(json.dumps({**values, "frames": frames}))
    colors = np.rint(255 * built_in().colors[::5]).astype(int)
    write_points(folder / "points3d.ply", built_in().points[::5], colors)
    return folder


def of_kind(folder, kind, *rooms):
    """A scene of a kind, loaded for each memory limit."""
    changes = dict(KINDS[kind])
    downscale = changes.pop("downscale", 1)
    write_scene(folder, **changes)
    return [load_scene(folder, room=room, downscale=downscale) for room in rooms]


def views_of(scene):
    return (*scene.train, *scene.test)


def num_readers():
    """Threads that read photographs ahead."""
    return sum(thread.name.startswith("photographs") for thread in threading.enumerate())


@pytest.mark.parametrize("kind", KINDS)
def test_batches_are_of_the_same_bits_wherever_photographs_are(tmp_path, kind, cache):
    held, on_disk = of_kind(tmp_path / "scene", kind, None, 0)
    assert all(view.picture.is_held for view in held.train)
    assert not any(view.picture.is_held for view in views_of(on_disk))
    for one, other in zip(views_of(held), views_of(on_disk), strict=True):
        assert one.has_alpha == other.has_alpha and one.picture.shape == other.picture.shape
        np.testing.assert_array_equal(one.picture.read(), other.picture.read())
    order = BatchOrder(held.train, 2, 0)
    stores = [PhotoStore(scene.train, order, 7, room=0) for scene in (held, on_disk)]
    for iteration in range(1, 8):
        (one, _), (other, _) = (store.batch(iteration) for store in stores)
        jax.tree.map(np.testing.assert_array_equal, one, other)
    for store in stores:
        store.close()
    assert not cache.is_dir() or not [path for path in cache.iterdir() if path.is_file()], "the file has a name"


@pytest.mark.long
def test_training_gives_the_same_bits_wherever_photographs_are(tmp_path, monkeypatch):
    """Compared with photographs in memory, brought to the device batch by batch. The threads end with training."""
    monkeypatch.setattr(loop, "PhotoStore", lambda *given: PhotoStore(*given, room=0))
    models = []
    seen = []
    for scene in of_kind(tmp_path / "scene", "undistorted", None, 0):
        keep = lambda _: seen.append(num_readers())  # noqa: E731
        models.append(fit(scene, SYSTEM, on_checkpoint=keep).model)
        assert seen.pop() > 0 == num_readers()
    assert_same(*(model.gaussians for model in models))


def test_memory_takes_as_many_photographs_as_it_has_room_for(tmp_path):
    scene = load_scene(write_scene(tmp_path / "scene"), room=2 * 40 * 32 * 3 + 1)
    assert sum(view.picture.is_held for view in views_of(scene)) == 2
    store = PhotoStore(scene.train, BatchOrder(scene.train, 1, 0), 12)
    assert not store.is_resident
    store.close()


@pytest.mark.parametrize("room", [None, 0])
def test_photographs_stay_on_no_device_if_one_process_lacks_the_room(monkeypatch, room):
    """Three cases: another process has no room, this one has none, both have some."""
    views = built_in().train
    given = []
    for other in (False, True):
        monkeypatch.setattr(batches, "any_process", lambda _, own, other=other: given.append(own) or own or other)
        store = PhotoStore(views, BatchOrder(views, 1, 0), 12, room=room)
        store.close()
        assert store.is_resident == (room is None and not other)
    assert given == [room == 0] * 2


def test_all_batches_have_opacities_and_masks_where_one_has(tmp_path):
    views = list(of_kind(tmp_path / "scene", "with opacity", 0)[0].train)
    views[0] = dataclasses.replace(views[0], mask=np.eye(32, 40, dtype=bool))
    store = PhotoStore(tuple(views), BatchOrder(tuple(views), 1, 0), len(views), room=0)
    found = [store.batch(iteration)[0] for iteration in range(1, len(views) + 1)]
    store.close()
    assert sum(int(batch.masks.sum()) == 32 for batch in found) == 1
    assert sum(bool((batch.alphas == 255).all()) for batch in found) == 1


def test_photographs_that_other_processes_draw_are_not_read(monkeypatch):
    """Neither their masks and depth maps."""
    read = []

    def counted(view):
        load = lambda: read.append(view.name) or np.full((32, 40, 4), 9, np.uint8)  # noqa: E731
        picture = Picture((32, 40, 4), load)
        depth = np.ones((32, 40), np.float32)
        return dataclasses.replace(view, picture=picture, mask=np.ones((32, 40), bool), depth=depth)

    views = tuple(map(counted, built_in().train))
    order = BatchOrder(views, 3, 0)
    monkeypatch.setattr(batches, "views_here", lambda *_: [1])
    store = PhotoStore(views, order, 1, has_depths=True, room=0)
    batch, places = store.batch(1)
    store.close()
    assert read == [views[order.indices(1)[1]].name] and places is None
    for arrays in (batch.images, batch.alphas, batch.masks, batch.depths):
        assert len(arrays) == 1 and arrays.all()
    np.testing.assert_array_equal(batch.viewmats[0], views[order.indices(1)[1]].camera.viewmat)


CHANGES = {
    "gone": lambda file: file.unlink(),
    "another": lambda file: Image.fromarray(np.zeros((32, 40, 3), np.uint8)).save(file),
    "cut off": lambda file: file.write_bytes(file.read_bytes()[:200]),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_photograph_that_does_not_stay_is_named(tmp_path, change):
    folder = write_scene(tmp_path / "scene")
    scene = load_scene(folder, room=0)
    victim = folder / scene.train[2].name
    change(victim)
    with pytest.raises(ValueError, match=f"{victim.name}: (cannot be read|has changed since)"):
        fit(scene, SYSTEM)
    assert num_readers() == 0


def test_batches_are_made_ahead_in_order_and_errors_stay_with_theirs():
    made = []

    def load(indices):
        made.append(indices[0])
        if indices == (7,):
            raise ValueError("photograph 7 is gone")
        return indices

    ahead = Ahead(load, 2)
    for iteration in (1, 2, 3, 4, 5):
        wanted = {key: (key,) for key in range(iteration, min(iteration + 2, 5) + 1)}
        assert ahead.first(wanted) == (iteration,)
    assert sorted(made) == [1, 2, 3, 4, 5], "each once"
    assert ahead.first({6: (6,), 7: (7,), 8: (8,)}) == (6,)
    with pytest.raises(ValueError, match="photograph 7 is gone"):
        ahead.first({7: (7,), 8: (8,)})
    assert ahead.first({8: (8,)}) == (8,)
    ahead.close()


def test_shelves_are_filled_and_read_by_many_threads():
    shelf = Shelf(0)
    images = [np.full((7, 5, 3), value, np.uint8) for value in range(60)]
    kept: dict[int, Picture] = {}

    def work(start):
        for index in range(start, 60, 4):
            kept[index] = shelf.keep(images[index])
            time.sleep(0)
            np.testing.assert_array_equal(kept[index].read(), images[index])

    threads = [threading.Thread(target=work, args=(start,)) for start in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(kept) == 60
    for index, picture in kept.items():
        np.testing.assert_array_equal(picture.read(), images[index])


def test_a_full_disk(monkeypatch):
    def full(**_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    with pytest.raises(OSError, match=r"cannot keep the scene's photographs \(No space left.*larger downscale"):
        Shelf(0).keep(np.zeros((4, 4, 3), np.uint8))


@pytest.mark.parametrize(("kind", "room"), [*((kind, 0) for kind in KINDS), ("undistorted", None)])
def test_a_scene_is_pickled_and_copied(tmp_path, kind, room):
    """Photographs that are read from their files as they are stay there; all others travel with the pickle."""
    (scene,) = of_kind(tmp_path / "scene", kind, room)
    scene = dataclasses.replace(scene, test=(dataclasses.replace(scene.test[0], depth=np.full((2, 3), 0.5)),))
    again = pickle.loads(pickle.dumps(scene))
    for before, after in zip(views_of(scene), views_of(again), strict=True):
        np.testing.assert_array_equal(after.picture.read(), before.picture.read())
        assert_same(after.camera, before.camera)
    np.testing.assert_array_equal(again.test[0].depth.read(), scene.test[0].depth.read())
    is_left = room == 0 and kind in ("as in their files", "with opacity")
    assert again.train[0].picture.is_held != is_left
    assert copy.deepcopy(scene).train[0].picture is scene.train[0].picture
