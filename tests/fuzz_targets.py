"""What readers of `fuzz_readers` read, and what must hold then."""

from pathlib import Path

import jax
import numpy as np
from fuzz_commands import run_commands

import a2tg_jax as a2tg
from a2tg_jax import load_checkpoint, load_scene
from a2tg_jax.data.decoding import read_pixels
from a2tg_jax.data.ply import read_ply_points
from a2tg_jax.measure import metrics
from a2tg_jax.results.figures import curves_figure
from a2tg_jax.results.folder import RunFolder, check_free, open_run
from a2tg_jax.results.history import read_history
from a2tg_jax.results.info import describe_run
from a2tg_jax.results.record import read_record
from a2tg_jax.training.start import initial_state


def _scene(folder: Path, file: Path) -> None:
    scene = load_scene(folder)
    views = (*scene.train, *scene.test)
    assert len(views) >= 2 and np.isfinite(scene.scale) and scene.scale > 0
    assert np.isfinite(scene.points).all() and np.isfinite(scene.colors).all() and len(scene.points) >= 2
    for view in views:
        viewmat = np.asarray(view.camera.viewmat, np.float64)
        K = np.asarray(view.camera.K, np.float64)
        assert np.isfinite(viewmat).all() and np.isfinite(K).all()
        assert np.abs(viewmat[:3, :3] @ viewmat[:3, :3].T - np.eye(3)).max() < 1e-2
        assert 1e-4 < K[0, 0] / view.camera.width < 1e6 and 1e-4 < K[1, 1] / view.camera.height < 1e6
        picture = getattr(view, "picture", None)
        pixels = view.image if picture is None else picture.read()
        assert pixels.dtype == np.uint8 and pixels.shape[:2] == (view.camera.height, view.camera.width)


def _points(folder: Path, file: Path) -> None:
    cloud = read_ply_points(file)
    assert cloud.points.shape == cloud.colors.shape and cloud.points.shape[1:] == (3,)


def _picture(folder: Path, file: Path) -> None:
    pixels = read_pixels(file)
    assert pixels.dtype == np.uint8 and pixels.ndim == 3 and pixels.shape[2] in (3, 4) and pixels.size


def _check_model(model):
    num = model.gaussians.means.shape[0]
    leaves = jax.tree.leaves((model.gaussians, model.appearance))
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in leaves)
    assert all(leaf.shape[0] == num for leaf in jax.tree.leaves(model.gaussians))
    if model.textures is not None:
        textures = model.textures
        bucket = np.asarray(textures.bucket)
        row = np.asarray(textures.row)
        sizes = np.asarray([len(texels) for texels in textures.buckets])
        assert bucket.shape == row.shape == (num,) and (num == 0 or (row < sizes[bucket]).all())
    if model.origin is not None:
        numbers = (model.origin.viewmats, model.origin.Ks, model.origin.transform.translation)
        assert all(np.isfinite(array).all() for array in numbers) and all(
            isinstance(n, str) for n in model.origin.names
        )
        assert len(model.origin.cameras) == len(model.origin.names)


def _checkpoint(folder: Path, file: Path):
    found = load_checkpoint(file)
    state = found.state
    stage = found.system.stages()[found.stage]
    _check_model(state.model)
    assert found.stage >= 0 and 0 <= int(state.model.num_live) <= state.model.gaussians.means.shape[0]
    assert 0 <= found.iteration <= stage.iterations
    wanted = jax.eval_shape(lambda: initial_state(stage, state.model))
    for got, like in ((state.moments, wanted.moments), (state.model, wanted.model)):
        shapes = [leaf.shape for leaf in jax.tree.leaves(got)]
        assert shapes == [leaf.shape for leaf in jax.tree.leaves(like)]
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(state.moments.mu))
    lengths = {len(column) for column in found.history.to_dict().values()}
    assert len(lengths) == 1
    return found.model


def _lpips(folder: Path, file: Path) -> None:
    metrics._load_lpips.cache_clear()
    assert all(np.isfinite(array).all() for array in metrics.load_lpips(file).arrays.values())


def _info(folder: Path, file: Path) -> None:
    assert describe_run(open_run(folder))


def _history(folder: Path, file: Path) -> None:
    history = read_history(file)
    assert np.isfinite(history.last_seconds) and np.isfinite(history.loss).all()
    curves_figure({"a": history}, {"a": 0})


def _record(folder: Path, file: Path) -> None:
    assert read_record(open_run(folder)).systems


def _marker(folder: Path, file: Path) -> None:
    run = RunFolder(folder)
    assert all(path.resolve().is_relative_to(folder) for path in run.files())
    check_free(folder, overwrite=True)


def _run(folder: Path, file: Path) -> None:
    run_commands(next(path for path in file.parents if path.parent == folder))


LOADERS = {
    "model": a2tg.load_model,
    "compact": a2tg.load_compact,
    "ply": lambda file: a2tg.Model(a2tg.load_ply(file)),
    "splats": a2tg.load_splats,
    "gltf": a2tg.load_gltf,
}
TARGETS = {
    "scene": _scene, "points": _points, "picture": _picture, "checkpoint": _checkpoint, "lpips": _lpips,
    "info": _info, "history": _history, "record": _record, "marker": _marker, "run": _run,
    **{name: lambda _, file, load=load: _check_model(load(file)) for name, load in LOADERS.items()},
}  # fmt: skip
"""Functions that read the folder, or the file that was changed; an AssertionError: it should not have been taken."""
