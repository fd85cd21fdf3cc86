"""Sound files for every reader that is tried with changed ones."""

import dataclasses
import shutil
import zipfile
from pathlib import Path
from zipfile import ZIP_DEFLATED

import jax
import jax.numpy as jnp
import numpy as np
from fuzz_commands import write_runs
from fuzz_mutate import zipped
from fuzz_readers import PICTURES
from PIL import Image
from run_folders import create_run
from small_files import ATTRIBUTES
from small_models import some_checkpoint, some_model, with_row
from test_captures import write_metashape, write_polycam_with_depth, write_realityscan, write_record3d
from test_data_colmap import CAMERAS, write_scene as write_colmap
from test_data_transforms import FOCAL, SIZE, write_blender, write_frames, write_json, write_ply
from test_io import write_ply as write_splats
from test_others import OTHERS
from test_spz import SAFE_ORBIT, declaring, glb_of, gltf_of, with_records

import a2tg_jax as a2tg
from a2tg_jax import (
    BBSplat,
    Bytewise,
    History,
    Model,
    SuperGaussians,
    save_checkpoint,
    save_compact,
    save_gltf,
    save_model,
    save_ply,
)
from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.results.folder import RunFolder, write_json as write_run_json
from a2tg_jax.results.history import write_history
from a2tg_jax.results.record import RunRecord, SceneSource, write_record

SYSTEMS = {
    "a2tg": lambda: a2tg.A2tg(sh_degree=0),
    "bytewise": lambda: Bytewise(kernel_rate=0.01),
    "supergaussians": lambda: SuperGaussians(sh_degree=0),
    "bbsplat": lambda: BBSplat(sh_degree=0),
    "gaussians-2d": lambda: a2tg.Gaussians2d(sh_degree=0),
}
CAPTURES = {
    "polycam": write_polycam_with_depth, "record3d": write_record3d, "metashape": write_metashape,
    "realityscan": write_realityscan,
}  # fmt: skip
NUM_VIEWS = 4


def write_seeds(folder: Path) -> None:
    """A folder for each name of `READERS`."""
    _write_scenes(folder)
    _write_pictures(folder / "pictures")
    for name in ("models", "compact", "checkpoints", "gaussians", "ksplat", "splats", "gltf", "lpips"):
        (folder / name).mkdir()
    for name, system in SYSTEMS.items():
        model = _with_shapes(some_model(system()))
        save_model(folder / "models" / f"{name}.npz", model)
        if name in ("a2tg", "bytewise"):
            save_compact(folder / "compact" / f"{name}.a2tgz", model)
            save_gltf(folder / "gltf" / f"{name}.glb", model)
            save_gltf(folder / "gltf" / f"{name}.gltf", model)
        save_checkpoint(folder / "checkpoints" / f"{name}.npz", some_checkpoint(system()))
    save_ply(folder / "gaussians" / "gaussians.ply", some_model(), third_scale=False)
    save_ply(folder / "gaussians" / "third.ply", some_model())
    for name, encoding in (("ascii", "ascii"), ("big", "binary_big_endian")):
        write_splats(folder / "gaussians" / f"{name}.ply", ATTRIBUTES, np.ones((4, len(ATTRIBUTES))), encoding)
    shutil.copy(OTHERS / "scene.compressed.ply", folder / "gaussians" / "packed.ply")
    for file in OTHERS.glob("*.ksplat"):
        shutil.copy(file, folder / "ksplat")
    _write_splats(folder / "splats")
    described = gltf_of((OTHERS / "scene.spz").read_bytes(), "KHR_gaussian_splatting_compression_spz_2")
    (folder / "gltf" / "spz.glb").write_bytes(glb_of(described))
    _write_lpips(folder / "lpips" / "squeeze.npz")
    _write_run(folder / "run")
    write_runs(folder / "commands")
    jax.clear_caches()


def _write_splats(folder: Path) -> None:
    """SOG, also packed and as a folder, SPZ of versions 3 and 4, also with an extension, and .splat."""
    for name in ("scene.sog", "scene.spz"):
        shutil.copy(OTHERS / name, folder)
    with zipfile.ZipFile(folder / "scene.sog") as archive:
        archive.extractall(folder)
        contents = {name: archive.read(name) for name in archive.namelist()}
    (folder / "packed.sog").write_bytes(zipped({f"a/{name}": data for name, data in contents.items()}, ZIP_DEFLATED))
    (folder / "records.spz").write_bytes(with_records(SAFE_ORBIT, declaring(4)))
    model = a2tg.load_splats(folder / "scene.sog")
    a2tg.save_splats(folder / "gzip.spz", model)
    a2tg.save_splats(folder / "a.splat", model)


def _with_shapes(model: Model) -> Model:
    """The same model; kernels that have shapes differ."""
    if model.appearance.shapes is None:
        return model
    shapes = jnp.linspace(-2.0, 2.0, model.gaussians.num)
    return dataclasses.replace(model, appearance=model.appearance.with_shapes(shapes))


def _write_scenes(folder: Path) -> None:
    models = tuple(CAMERAS)
    for text, name in ((False, "colmap"), (True, "colmap-text")):
        reconstruction = write_colmap(folder / name, models=models, num_views=NUM_VIEWS, num_points=6, text=text)
        _add_tracks(reconstruction)
        write = reconstruction.write_text if text else reconstruction.write_binary
        write(str(folder / name / "sparse" / "0"))
    frames = write_frames(folder / "nerfstudio", NUM_VIEWS)
    write_ply(folder / "nerfstudio" / "points.ply")
    _write_masks(folder / "nerfstudio" / "masks")
    frames[1]["mask_path"] = "masks/01.png"
    write_json(folder / "nerfstudio", frames, ply_file_path="points.ply", k1=0.01, **FOCAL, **SIZE)
    for name, write_capture in CAPTURES.items():
        (folder / name).mkdir()
        write_capture(folder / name)
    (folder / "blender").mkdir()
    write_blender(folder / "blender")
    (folder / "points").mkdir()
    for name, encoding in (("ascii", "ascii"), ("little", "binary_little_endian"), ("big", "binary_big_endian")):
        write_ply(folder / "points" / f"{name}.ply", encoding)


def _add_tracks(reconstruction) -> None:
    """Every image sees every point, somewhere."""
    points = sorted(reconstruction.points3D)
    for key in sorted(reconstruction.images):
        places = [pycolmap().Point2D(np.asarray([10.0 + index, 5.0])) for index in range(len(points))]
        reconstruction.images[key].points2D = pycolmap().Point2DList(places)
        for index, point in enumerate(points):
            reconstruction.add_observation(point, pycolmap().TrackElement(key, index))


def _write_masks(folder: Path) -> None:
    """Of all views, the upper half."""
    folder.mkdir()
    mask = np.zeros((SIZE["h"], SIZE["w"]), np.uint8)
    mask[: SIZE["h"] // 2] = 255
    for index in range(NUM_VIEWS):
        Image.fromarray(mask).save(folder / f"{index:02d}.png")


def _write_pictures(folder: Path) -> None:
    folder.mkdir()
    pixels = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)
    for kind in PICTURES:
        Image.fromarray(pixels).save(folder / f"picture.{kind}")


def _write_lpips(file: Path) -> None:
    """SqueezeNet's layout, with all weights alike."""
    shapes = {"features.0": (64, 3, 3)}
    inputs = 64
    for index, squeezed in {3: 16, 4: 16, 6: 32, 7: 32, 9: 48, 10: 48, 11: 64, 12: 64}.items():
        shapes[f"features.{index}.squeeze"] = (squeezed, inputs, 1)
        shapes[f"features.{index}.expand1x1"] = (4 * squeezed, squeezed, 1)
        shapes[f"features.{index}.expand3x3"] = (4 * squeezed, squeezed, 3)
        inputs = 8 * squeezed
    arrays = {f"{name}.weight": np.ones((out, of, side, side), np.float32) for name, (out, of, side) in shapes.items()}
    arrays |= {f"{name}.bias": np.zeros(out, np.float32) for name, (out, _, _) in shapes.items()}
    for index, channels in enumerate([64, 128, 256, 384, 384, 512, 512]):
        arrays[f"lin{index}.weight"] = np.ones((1, channels, 1, 1), np.float32)
    np.savez(file, **arrays)


def _write_run(folder: Path) -> None:
    run: RunFolder = create_run(folder)
    write_record(run, RunRecord(SceneSource(str(folder.parent / "colmap")), "a2tg", a2tg.A2tg.preset("smoke")))
    quality = {"test": {"psnr": 30.0, "ssim": 0.9}, "train": {"psnr": 31.0, "ssim": 0.9}}
    write_run_json(run.own(run.metrics), {"scene": "x", "models": {"a2tg-textures": {**quality, "num_gaussians": 12}}})
    save_model(run.own(run.model("a2tg-textures")), some_model())
    history = History.empty()
    for iteration in range(1, 6):
        history = with_row(history, 1, iteration, 0.5 / iteration, 20.0, 12, 0.1, float(iteration), l1=0.25)
    write_history(run.own(folder / "history" / "a.csv"), history)
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)
