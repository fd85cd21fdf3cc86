"""The readers that files of strangers go through: which files, how they are changed, and what must hold once read.

`READERS` lists, for each, the files of which one is changed, and how. Only the worker imports what is behind `TARGETS`.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import fuzz_mutate as mutate
from fuzz_commands import SYSTEMS, run_commands

BINARY, TEXT = (mutate.of_bytes,), (mutate.of_text, mutate.of_text, mutate.of_bytes)
JSON = (mutate.of_json, mutate.of_json, mutate.of_json, mutate.of_text, mutate.of_bytes)
ARCHIVE = (mutate.of_npz, mutate.of_npz, mutate.of_npz, mutate.of_bytes)
COLMAP = ("cameras", "images", "points3D", "rigs", "frames")
OF_RUN = ("metrics.json", ".a2tg-run")
KSPLAT = ("0-degree1", "1-degree2", "2-degree2")
DEPTHS = ("depth", "confidence")
PICTURES = ("png", "jpg", "tif", "webp", "avif", "bmp", "gif", "ppm")


@dataclasses.dataclass(frozen=True)
class Reader:
    """What is changed, and how."""

    name: str
    files: tuple[str, ...]
    changes: tuple[Callable, ...]
    target: str
    """Which function of the worker reads the folder or the file."""

    @property
    def folder(self) -> str:
        """Below that of all sound files; masks are those of a scene that is tried itself."""
        return "nerfstudio" if self.name == "masks" else self.name


READERS = (
    *(Reader("colmap", (f"sparse/0/{kind}.bin",), BINARY, "scene") for kind in COLMAP[:3]),
    Reader("colmap", tuple(f"sparse/0/{kind}.bin" for kind in COLMAP[3:]), BINARY, "scene"),
    Reader("colmap-text", tuple(f"sparse/0/{kind}.txt" for kind in COLMAP), TEXT, "scene"),
    Reader("nerfstudio", ("transforms.json",), JSON, "scene"),
    Reader("masks", ("masks/00.png", "masks/01.png", "images/00.png"), (mutate.of_bytes, mutate.of_png), "scene"),
    Reader("blender", ("transforms_train.json", "transforms_test.json"), JSON, "scene"),
    Reader("polycam", tuple(f"keyframes/corrected_cameras/{index}.json" for index in range(4)), JSON, "scene"),
    Reader("polycam", tuple(f"keyframes/{kind}/1.png" for kind in DEPTHS), (mutate.of_bytes, mutate.of_png), "scene"),
    Reader("record3d", ("metadata",), JSON, "scene"),
    Reader("metashape", ("cameras.xml",), TEXT, "scene"),
    Reader("realityscan", tuple(f"{index}.xmp" for index in range(4)), TEXT, "scene"),
    Reader("points", ("ascii.ply",), TEXT, "points"),
    Reader("points", ("little.ply", "big.ply"), BINARY, "points"),
    Reader("pictures", tuple(f"picture.{kind}" for kind in PICTURES), BINARY, "picture"),
    Reader("pictures", ("picture.png",), (mutate.of_png,), "picture"),
    Reader("models", ("a2tg.npz", "bytewise.npz", "supergaussians.npz", "bbsplat.npz"), ARCHIVE, "model"),
    Reader("compact", ("a2tg.a2tgz", "bytewise.a2tgz"), (mutate.of_compact, mutate.of_bytes), "compact"),
    Reader("checkpoints", ("a2tg.npz", "bytewise.npz", "gaussians-2d.npz"), ARCHIVE, "checkpoint"),
    Reader("gaussians", ("gaussians.ply", "third.ply", "big.ply", "packed.ply"), BINARY, "gaussians"),
    Reader("gaussians", ("ascii.ply",), TEXT, "gaussians"),
    Reader("ksplat", tuple(f"level{level}.ksplat" for level in KSPLAT), BINARY, "splats"),
    Reader("gltf", ("a2tg.glb", "bytewise.glb"), (mutate.of_glb, mutate.of_glb, mutate.of_bytes), "gltf"),
    Reader("gltf", ("a2tg.gltf",), JSON, "gltf"),
    Reader("lpips", ("squeeze.npz",), ARCHIVE, "lpips"),
    Reader("run", ("metrics.json",), JSON, "info"),
    Reader("run", ("history/a.csv",), TEXT, "history"),
    Reader("run", ("run.toml",), TEXT, "record"),
    Reader("run", (".a2tg-run",), TEXT, "marker"),
    Reader("commands", tuple(f"{name}/run.toml" for name in SYSTEMS), (mutate.of_toml,) * 3 + (mutate.of_text,), "run"),
    Reader("commands", tuple(f"{name}/{file}" for name in SYSTEMS[:2] for file in OF_RUN), (mutate.of_text,), "run"),
)  # fmt: skip


def read(reader: Reader, folder: Path, file: Path, is_rendering: bool = False) -> None:
    """Reads what was changed, and draws it where it is a model; an AssertionError: it should not have been taken."""
    model = TARGETS[reader.target](folder, file)
    if is_rendering and model is not None:
        _render(model)


def _render(model) -> None:
    """One small picture, which may show anything."""
    import a2tg_jax as a2tg

    camera = a2tg.synthetic_scene(num_views=2, width=16, height=12, num_points=2).train[0].camera
    assert model.render(camera).color.shape == (12, 16, 3)


def _scene(folder: Path, file: Path) -> None:
    import numpy as np

    from a2tg_jax.data import load_scene

    scene = load_scene(folder)
    views = (*scene.train, *scene.test)
    assert len(views) >= 2 and np.isfinite(scene.scale) and scene.scale > 0
    assert np.isfinite(scene.points).all() and np.isfinite(scene.colors).all() and len(scene.points) >= 2
    for view in views:
        viewmat, K = np.asarray(view.camera.viewmat, np.float64), np.asarray(view.camera.K, np.float64)
        assert np.isfinite(viewmat).all() and np.isfinite(K).all()
        assert np.abs(viewmat[:3, :3] @ viewmat[:3, :3].T - np.eye(3)).max() < 1e-2
        assert 1e-4 < K[0, 0] / view.camera.width < 1e6 and 1e-4 < K[1, 1] / view.camera.height < 1e6
        picture = getattr(view, "picture", None)
        pixels = view.image if picture is None else picture.read()
        assert pixels.dtype == np.uint8 and pixels.shape[:2] == (view.camera.height, view.camera.width)


def _points(folder: Path, file: Path) -> None:
    from a2tg_jax.data.ply import read_ply_points

    cloud = read_ply_points(file)
    assert cloud.points.shape == cloud.colors.shape and cloud.points.shape[1:] == (3,)


def _picture(folder: Path, file: Path) -> None:
    import numpy as np

    try:
        from a2tg_jax.data.decoding import read_pixels
    except ImportError:  # Where they were before, so that an older version can be tried too.
        from a2tg_jax.data.image_files import read_pixels

    pixels = read_pixels(file)
    assert pixels.dtype == np.uint8 and pixels.ndim == 3 and pixels.shape[2] in (3, 4) and pixels.size


def _check_model(model):
    import jax
    import numpy as np

    num = model.gaussians.means.shape[0]
    leaves = jax.tree.leaves((model.gaussians, model.appearance))
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in leaves)
    assert all(leaf.shape[0] == num for leaf in jax.tree.leaves(model.gaussians))
    if model.textures is not None:
        textures = model.textures
        bucket, row = np.asarray(textures.bucket), np.asarray(textures.row)
        sizes = np.asarray([len(texels) for texels in textures.buckets])
        assert bucket.shape == row.shape == (num,) and (num == 0 or (row < sizes[bucket]).all())
    if model.origin is not None:
        numbers = (model.origin.viewmats, model.origin.Ks, model.origin.transform.translation)
        assert all(np.isfinite(array).all() for array in numbers) and all(
            isinstance(n, str) for n in model.origin.names
        )
        assert len(model.origin.cameras) == len(model.origin.names)


def _model(folder: Path, file: Path):
    from a2tg_jax import load_model

    return _check_model(load_model(file))


def _compact(folder: Path, file: Path):
    from a2tg_jax import load_compact

    return _check_model(load_compact(file))


def _checkpoint(folder: Path, file: Path):
    import jax
    import numpy as np

    from a2tg_jax.training import load_checkpoint
    from a2tg_jax.training.step import initial_state

    found = load_checkpoint(file)
    state, stage = found.state, found.system.stages()[found.stage]
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


def _gaussians(folder: Path, file: Path):
    from a2tg_jax import Model, load_ply

    return _check_model(Model(load_ply(file)))


def _splats(folder: Path, file: Path):
    from a2tg_jax import load_splats

    return _check_model(load_splats(file))


def _gltf(folder: Path, file: Path):
    from a2tg_jax import load_gltf

    return _check_model(load_gltf(file))


def _lpips(folder: Path, file: Path) -> None:
    import numpy as np

    from a2tg_jax.measure import metrics

    metrics._load_lpips.cache_clear()
    assert all(np.isfinite(array).all() for array in metrics.load_lpips(file).arrays.values())


def _info(folder: Path, file: Path) -> None:
    from a2tg_jax.results.folder import open_run
    from a2tg_jax.results.info import describe_run

    assert describe_run(open_run(folder))


def _history(folder: Path, file: Path) -> None:
    import numpy as np

    from a2tg_jax.results.figures import curves_figure
    from a2tg_jax.results.history import read_history

    history = read_history(file)
    assert np.isfinite(history.last_seconds) and np.isfinite(history.loss).all()
    curves_figure({"a": history}, {"a": 0})


def _record(folder: Path, file: Path) -> None:
    from a2tg_jax.results.folder import open_run
    from a2tg_jax.results.record import read_record

    assert read_record(open_run(folder)).systems


def _marker(folder: Path, file: Path) -> None:
    from a2tg_jax.results.folder import RunFolder, check_free

    run = RunFolder(folder)
    names = run.written()
    if hasattr(run, "own_files"):
        assert all(path.resolve().is_relative_to(folder) for path in run.own_files(names))
    check_free(folder, overwrite=True)


def _run(folder: Path, file: Path) -> None:
    run_commands(next(path for path in file.parents if path.parent == folder))


TARGETS = {
    "scene": _scene, "points": _points, "picture": _picture, "model": _model, "compact": _compact,
    "checkpoint": _checkpoint, "gaussians": _gaussians, "splats": _splats, "gltf": _gltf, "lpips": _lpips,
    "info": _info, "history": _history, "record": _record, "marker": _marker, "run": _run,
}  # fmt: skip
