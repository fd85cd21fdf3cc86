"""Training steps on a real scene, and views of the trained model."""

import dataclasses
import pathlib

import numpy as np

import a2tg_jax
from a2tg_jax import A2tg
from a2tg_jax.core.cameras import resize_camera
from a2tg_jax.mcmc import Mcmc
from a2tg_jax.systems.baselines import Gaussians2dMcmc
from a2tg_jax.training import fit_stage, like
from benchmarks.rendering import measure_view


def measure_training(case: dict) -> dict:
    """Measure warm steps of both stages: median milliseconds of the last ones, without compilation."""
    scene, textured = load_case(case)
    plain = like(Gaussians2dMcmc, textured)
    first = fit_stage(scene, textured, 0, progress=False)
    height, width = scene.train[0].picture.size
    return {
        "scene": scene.name,
        "image": [width, height],
        "num_live": first.model.num,
        "stage1_ms": late_step_ms(first.history),
        "untextured_ms": late_step_ms(fit_stage(scene, plain, 1, first.model, progress=False).history),
        "textured_ms": late_step_ms(fit_stage(scene, textured, 1, first.model, progress=False).history),
    }


def measure_trained(case: dict) -> dict:
    """Measure a test view after short training, at several sizes, without and with the textures."""
    scene, system = load_case(case)
    model = a2tg_jax.fit(scene, system, progress=False).model
    camera, settings = scene.test[0].camera, a2tg_jax.RenderSettings(tile_size=system.tile_size)
    renders = []
    for factor in case["factors"]:
        view = resize_camera(camera, factor * camera.width, factor * camera.height)
        for kind, textures in (("none", None), ("trained", model.textures)):
            figures = measure_view(model.gaussians, view, textures, settings)
            renders.append({"width": view.width, "height": view.height, "textures": kind, **figures})
    return {"scene": scene.name, "num": model.num, "renders": renders}


def load_case(case: dict) -> tuple[a2tg_jax.Scene, A2tg]:
    """Return the scene and a system for a short training."""
    scene = a2tg_jax.load_scene(pathlib.Path(case["scene"]), downscale=case["downscale"])
    stage1, stage2 = case["iterations"]
    system = dataclasses.replace(
        A2tg.preset("quick"),
        stage1_iterations=stage1,
        stage2_iterations=stage2,
        densify=Mcmc(cap=case["num"]),
    )
    return scene, system


def late_step_ms(history: a2tg_jax.History) -> float:
    """Return milliseconds a step, the median over the last half of the log."""
    steps = np.diff(history.seconds) / np.diff(history.iteration)
    return float(np.median(steps[-(len(steps) // 2) :])) * 1e3
