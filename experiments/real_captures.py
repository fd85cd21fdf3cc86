"""Gain and cost of masks, exposures and refined poses on captures that are disturbed by known amounts.

    python experiments/real_captures.py --out OUT                       # the built-in scene
    python experiments/real_captures.py --out OUT --scenes SCENES       # and fox and snowmiku in that folder

Every training is kept in OUT/real_captures.json as soon as it is measured, so that a second call goes on; tables are
written to OUT/real_captures.md. Half an hour on two cores.
"""

import argparse
import bisect
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from lab import tables
from lab.interrupts import interruptible
from lab.kept import read_kept
from scipy.spatial.transform import Rotation

import a2tg_jax as a2tg
from a2tg_jax.core.cameras import moved_viewmat
from a2tg_jax.core.similarity import camera_centers
from a2tg_jax.host.machine import tidy_memory
from a2tg_jax.results.folder import write_json
from a2tg_jax.results.run_evaluation import refined_views
from a2tg_jax.training.corrections import exposed

DEGREES, SHARE = 0.5, 0.01
"""Angle and distance by which each camera moves; the latter in units of the median distance to the scene."""
SYSTEM = dataclasses.replace(
    a2tg.Gaussians2dMcmc.preset("quick"),
    stage1_iterations=1_000,
    stage2_iterations=0,
    densify=a2tg.Mcmc(cap=2_000),
)
VARIANTS: dict[str, dict[str, Any]] = {"": {}, "exposure": {"exposure": True}, "poses": {"refine_poses": True}}

Scene = a2tg.Scene


def each_view(scene: Scene, change: Callable[[np.random.Generator, a2tg.View], a2tg.View], *, has_test: bool) -> Scene:
    """Return the scene with its training views changed, and its test views too if requested."""
    rng = np.random.default_rng(0)
    train = tuple(change(rng, view) for view in scene.train)
    return dataclasses.replace(
        scene, train=train, test=tuple(change(rng, view) for view in scene.test) if has_test else scene.test
    )


def with_poses(rng: np.random.Generator, view: a2tg.View) -> a2tg.View:
    """Return a view, its camera turned by `DEGREES` about a random axis and moved by `SHARE` in a random direction."""
    directions = rng.normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    twist = (directions * [[np.deg2rad(DEGREES)], [SHARE]]).ravel()
    viewmat = moved_viewmat(jnp.asarray(twist, jnp.float32), view.camera.viewmat)
    return dataclasses.replace(view, camera=dataclasses.replace(view.camera, viewmat=viewmat))


def with_exposure(rng: np.random.Generator, view: a2tg.View) -> a2tg.View:
    """Return a photograph with each channel times 0.8 to 1.25 and up to 0.05 brighter or darker."""
    gains, offsets = np.exp(rng.uniform(-1, 1, 3) * np.log(1.25)), rng.uniform(-0.05, 0.05, 3)
    color = np.clip(view.image / 255 * gains + offsets, 0, 1)
    return dataclasses.replace(view, picture=np.rint(255 * color).astype(np.uint8))


def with_passers_by(rng: np.random.Generator, view: a2tg.View, *, is_masked: bool) -> a2tg.View:
    """Return a photograph with two rectangles of noise, each a fifth of its sides; masked or not."""
    image, mask = view.image.copy(), np.ones(view.picture.size, bool)
    height, width = view.picture.size[0] // 5, view.picture.size[1] // 5
    for _ in range(2):
        top, left = rng.integers(0, 4 * height), rng.integers(0, 4 * width)
        there = slice(top, top + height), slice(left, left + width)
        image[there] = rng.integers(0, 256, (height, width, 3)) // 2 + rng.integers(0, 128, 3)
        mask[there] = False
    return dataclasses.replace(view, picture=image, mask=mask if is_masked else None)


def disturbances(scene: Scene) -> dict[str, Scene]:
    """Return the scene as it is, and disturbed in each way."""
    return {
        "as it is": scene,
        "poses disturbed": each_view(scene, with_poses, has_test=True),
        "exposures changed": each_view(scene, with_exposure, has_test=False),
        "passers-by": each_view(scene, lambda rng, view: with_passers_by(rng, view, is_masked=False), has_test=False),
        "passers-by, masked": each_view(
            scene, lambda rng, view: with_passers_by(rng, view, is_masked=True), has_test=False
        ),
    }


TRAININGS = {
    "synthetic": (
        ("as it is", ""), ("as it is", "poses"), ("as it is", "exposure"), ("poses disturbed", ""),
        ("poses disturbed", "poses"), ("exposures changed", ""), ("exposures changed", "exposure"), ("passers-by", ""),
        ("passers-by, masked", ""),
    ),
    "fox": (("as it is", ""), ("as it is", "poses"), ("poses disturbed", ""), ("poses disturbed", "poses")),
    "snowmiku": (("as it is", ""), ("as it is", "exposure")),
}  # fmt: skip
"""Disturbance and learned correction of each training, by scene."""
ITERATIONS = {"snowmiku": 3_000}
"""Iterations of scenes with more views."""


def pose_error(viewmats: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Return the mean angle (degrees) and distance of cameras from their true ones, after the best similarity."""
    centers, wanted = camera_centers(viewmats), camera_centers(true)
    a, b = centers - centers.mean(axis=0), wanted - wanted.mean(axis=0)
    left, values, right = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.sign(np.linalg.det(left @ right))])
    turn, scale = (left * signs) @ right, (values * signs).sum() / (a * a).sum()
    angles = Rotation.from_matrix(viewmats[:, :3, :3] @ turn.T @ true[:, :3, :3].transpose(0, 2, 1)).magnitude()
    return float(np.rad2deg(angles.mean())), float(np.linalg.norm(scale * a @ turn.T - b, axis=1).mean())


def viewmats_of(views: tuple[a2tg.View, ...]) -> np.ndarray:
    return np.stack([np.asarray(view.camera.viewmat, np.float64) for view in views])


def measured(scene: Scene, disturbed: Scene, variant: str, iterations: int) -> dict[str, float]:
    """Train once; return PSNR of test views as they are, up to exposure, up to pose, and errors of training cameras."""
    system = dataclasses.replace(SYSTEM, stage1_iterations=iterations, **VARIANTS[variant])
    model = a2tg.fit(disturbed, system, progress=False, session=a2tg.Session(tidy_memory)).model
    refined, test = refined_views(disturbed.train, model), disturbed.test
    before, after = (pose_error(viewmats_of(views), viewmats_of(scene.train)) for views in (disturbed.train, refined))
    return {
        "test": a2tg.evaluate(test, model).psnr,
        "test_color_fit": a2tg.evaluate(test, model, fit_colors=True).psnr,
        "test_aligned": a2tg.evaluate(a2tg.align_poses(test, model), model).psnr,
        **with_neighbours(test, model),
        "degrees_before": before[0], "distance_before": before[1], "degrees": after[0], "distance": after[1],
    }  # fmt: skip


def with_neighbours(test: Sequence[a2tg.View], model: a2tg.Model) -> dict[str, float]:
    """Return PSNR of test views under the mean exposure of neighbouring training views; empty without exposures."""
    origin = model.origin
    if origin is None or "exposure" not in origin.corrections:
        return {}
    learned = dict(zip(origin.names, origin.corrections["exposure"], strict=True))
    names = [name for name, is_test in zip(origin.names, origin.is_test, strict=True) if not is_test]
    renderer, decibels = a2tg.Renderer(model, has_geometry=False), []
    for view in test:
        at = bisect.bisect(names, view.name)
        exposure = np.mean([learned[name] for name in names[max(at - 1, 0) : at + 1]], axis=0)
        shown = exposed(jnp.asarray(exposure), renderer(view.camera).color)
        decibels.append(float(a2tg.psnr(shown, jnp.asarray(a2tg.view_image(view, model.background)))))
    return {"test_neighbours": float(np.mean(decibels))}


def load(name: str, folder: Path | None) -> Scene:
    """Return the built-in scene at 160×120, or one of the folder at a quarter of its size."""
    if name == "synthetic":
        return a2tg.synthetic_scene(width=160, height=120)
    assert folder is not None
    return a2tg.load_scene(folder / name, downscale=4)


def table(found: Mapping[str, Mapping[str, float]]) -> str:
    """Return a table with a row for every training."""
    names = {"test": "test", "test_neighbours": "neighbours'", "test_color_fit": "fitted", "test_aligned": "aligned"}
    header = ["scene", "capture", "learned", *names.values(), "poses off by"]
    rows = []
    for scene, capture, variant in ((name, *each) for name, trainings in TRAININGS.items() for each in trainings):
        figures = found.get(f"{scene} | {capture} | {variant}")
        if figures is None:
            continue
        decibels = [f"{figures[name]:.2f}" if name in figures else tables.MISSING for name in names]
        off = f"{figures['degrees_before']:.2f}°, {figures['distance_before']:.4f}"
        if variant == "poses":
            off += f" → {figures['degrees']:.2f}°, {figures['distance']:.4f}"
        rows.append([scene, capture, variant or "–", *decibels, off])
    return tables.markdown(header, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of tables and figures")
    parser.add_argument("--scenes", type=Path, help="folder with fox and snowmiku")
    arguments = parser.parse_args()
    a2tg.configure_cpu()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "real_captures.json"
    found = read_kept(path)
    for name, trainings in TRAININGS.items():
        if name != "synthetic" and arguments.scenes is None:
            continue
        scene = load(name, arguments.scenes)
        captures = disturbances(scene)
        for capture, variant in trainings:
            key = f"{name} | {capture} | {variant}"
            if key not in found:
                iterations = ITERATIONS.get(name, SYSTEM.stage1_iterations)
                found[key] = measured(scene, captures[capture], variant, iterations)
                write_json(path, found)
                (arguments.out / "real_captures.md").write_text(table(found), encoding="utf-8")
    print(table(found))


if __name__ == "__main__":
    with interruptible():
        main()
