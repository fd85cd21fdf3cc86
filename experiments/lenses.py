"""Photographs of a fisheye lens: kept as they are, or undistorted to a pinhole first?

    python experiments/lenses.py --out OUT

The built-in scene is ray-traced behind an OPENCV_FISHEYE lens, written as photographs with a transforms.json, and read
in both ways. Held-out photographs are drawn through the lens. PSNR is over all of their pixels with a ray, and over
those that undistortion keeps. Gaussians, bytes and iterations are the same.

Each training is kept in OUT/lenses.json as soon as it is measured, so that a second call goes on. The table is
OUT/lenses.md.
"""

import dataclasses
import functools
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from few_views import GAUSSIAN_KERNELS
from lab import tables
from lab.interrupts import interruptible
from lab.kept import KeptFigures, parser_of
from PIL import Image

import a2tg_jax as a2tg
from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.lenses import Lens
from a2tg_jax.data.ray_tracing import Surface, light, trace_rays
from a2tg_jax.data.synthetic import SAMPLE_OFFSETS, camera_path, still_life, viewmat_to_target
from a2tg_jax.host.machine import tidy_memory
from a2tg_jax.io.config_json import changed_config

SIZE = 208, 156
"""Width and height of the photographs in pixels."""
LENSES = {
    "90° across": (132.0, 0.02),
    "120° across": (99.0, -0.01),
}
"""Focal length in pixels and first distortion parameter by the angle of view across the longer side."""
NUM_VIEWS = 28
BUDGET = 0.3
USES = ("keep", "undistort")


def lens_of(name: str) -> Lens:
    """Return a lens by its name."""
    focal, k1 = LENSES[name]
    width, height = SIZE
    params = [focal, focal, width / 2, height / 2, k1, 0.0, 0.0, 0.0]
    return Lens(pycolmap().Camera(model="OPENCV_FISHEYE", width=width, height=height, params=params), is_kept=True)


def photograph(surfaces: Sequence[Surface], viewmat: np.ndarray, lens: Lens) -> np.ndarray:
    """Return the image [H, W, 3] uint8 that the lens sees, the mean of a few rays a pixel; black where it has none."""
    width, height = SIZE
    x, y = (grid.ravel() + 0.5 for grid in np.meshgrid(np.arange(width), np.arange(height)))
    center = (-viewmat[:3, :3].T @ viewmat[:3, 3:]).astype(np.float32)
    samples = []
    for offset in SAMPLE_OFFSETS.T:
        slopes = np.nan_to_num(np.asarray(lens.camera.cam_from_img(np.stack([x, y], -1) + offset)))
        rays = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) @ viewmat[:3, :3]
        samples.append(trace_rays(surfaces, center, rays.T.astype(np.float32))[0].astype(np.float64))
    image = np.rint(np.mean(samples, axis=0)).astype(np.uint8).reshape(height, width, 3)
    rays_of_pixels = lens.rays(width, height)
    return np.where(np.isfinite(rays_of_pixels).all(axis=2)[..., None], image, np.uint8(0))


def write_scene(folder: Path, name: str) -> None:
    """Write the photographs of a lens and their transforms.json, with the points of the built-in scene."""
    rng = np.random.default_rng(0)
    surfaces, lens = light(still_life(rng), rng), lens_of(name)
    (folder / "images").mkdir(parents=True)
    frames = []
    for index, center in enumerate(camera_path(NUM_VIEWS)):
        viewmat = viewmat_to_target(center)
        file = f"images/view_{index:03d}.png"
        Image.fromarray(photograph(surfaces, viewmat, lens)).save(folder / file)
        camera_to_world = np.linalg.inv(viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": file, "transform_matrix": camera_to_world.tolist()})
    focal, k1 = LENSES[name]
    width, height = SIZE
    intrinsics = {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    distortion = {"camera_model": "OPENCV_FISHEYE", "k1": k1, "k2": 0.0, "k3": 0.0, "k4": 0.0}
    (folder / "transforms.json").write_text(json.dumps({**intrinsics, **distortion, "frames": frames}))


def read_scene(folder: Path, use: Any) -> a2tg.Scene:
    """Return the scene read in one way, with the points of the built-in scene, which has none of its own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = a2tg.load_scene(folder, lens=use)
    built_in = a2tg.synthetic_scene(num_views=NUM_VIEWS, width=SIZE[0], height=SIZE[1])
    points = scene.transform.apply(built_in.transform.inverse().apply(built_in.points))
    return dataclasses.replace(scene, points=np.asarray(points, np.float32), colors=built_in.colors)


def measured(folder: Path, name: str, use: str) -> dict[str, float]:
    """Return the figures of one training."""
    if not (folder / "transforms.json").is_file():
        write_scene(folder, name)
    scene, kept = read_scene(folder, use), read_scene(folder, "keep")
    options = {**GAUSSIAN_KERNELS, "memory_budget": BUDGET}
    system = changed_config(a2tg.find_system("bytewise").preset("quick"), options, "lenses")
    model = a2tg.fit(scene, system, progress=False, session=a2tg.Session(tidy_memory)).model
    is_cropped = seen_when_undistorted(name)
    masked = [dataclasses.replace(view, mask=is_cropped & counted(view)) for view in kept.test]
    return {
        "psnr": a2tg.evaluate(kept.test, model).psnr,
        "psnr_cropped": a2tg.evaluate(masked, model).psnr,
        "share": float(is_cropped.mean()),
        "num_gaussians": model.num,
    }


def counted(view: a2tg.View) -> np.ndarray:
    """Return [H, W] whether pixels count."""
    return np.ones(view.picture.size, bool) if view.mask is None else view.mask.read()


def seen_when_undistorted(name: str) -> np.ndarray:
    """Return [H, W] whether a pixel's ray lies in the undistorted image."""
    lens = lens_of(name)
    K, (width, height) = Lens(lens.camera).pinhole
    rays = lens.rays(*SIZE)
    own = lens.camera.calibration_matrix()
    slopes = (rays - own[:2, 2]) / np.diag(own)[:2]
    places = slopes * np.diag(K)[:2] + K[:2, 2]
    return np.asarray(((places >= 0) & (places <= (width, height))).all(axis=2))


def table(found: Mapping[str, Mapping[str, float]]) -> str:
    """Return a row for each lens."""
    rows = []
    for name in LENSES:
        cells = [found.get(f"{name} | {use}") for use in USES]
        known = next((cell for cell in cells if cell is not None), None)
        if known is None:
            continue
        shown = [tables.MISSING if c is None else f"{c['psnr']:.2f} / {c['psnr_cropped']:.2f}" for c in cells]
        rows.append([name, *shown, f"{known['share']:.0%}"])
    return tables.markdown(["lens", "kept: dB, all / cropped", "undistorted", "pixels left by undistortion"], rows)


def main() -> None:
    arguments = parser_of(__doc__).parse_args()
    a2tg.configure_cpu()
    kept = KeptFigures(arguments.out, "lenses", table)
    for name in LENSES:
        folder = arguments.out / name.replace("° ", "-")
        for use in USES:
            kept.measure(f"{name} | {use}", functools.partial(measured, folder, name, use))
    print(kept.table())


if __name__ == "__main__":
    with interruptible():
        main()
