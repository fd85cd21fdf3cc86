"""Training steps on a real scene, and views of what was trained."""

import dataclasses
import pathlib

import numpy as np

import a2tg_jax
from a2tg_jax.cameras import resize_camera
from benchmarks.rendering import measure_view


def measure_training(case: dict) -> dict:
    """Warm steps of both stages: median milliseconds of the last ones, compilation apart."""
    scene, config = load_case(case)
    plain = dataclasses.replace(config, texture=dataclasses.replace(config.texture, is_enabled=False))
    first = a2tg_jax.fit_stage1(scene, config, progress=False)
    untextured = a2tg_jax.fit_stage2(scene, first.gaussians, plain, progress=False)
    textured = a2tg_jax.fit_stage2(scene, first.gaussians, config, progress=False)
    height, width = scene.train[0].image.shape[:2]
    return {
        "scene": scene.name,
        "image": [width, height],
        "num_live": first.gaussians.num,
        "stage1_ms": late_step_ms(first.history),
        "untextured_ms": late_step_ms(untextured.history),
        "textured_ms": late_step_ms(textured.history),
    }


def measure_trained(case: dict) -> dict:
    """A test view after short training, at several sizes, without and with the textures."""
    scene, config = load_case(case)
    result = a2tg_jax.fit(scene, config, progress=False)
    camera, settings = scene.test[0].camera, a2tg_jax.render_settings(config)
    renders = []
    for factor in case["factors"]:
        view = resize_camera(camera, factor * camera.width, factor * camera.height)
        for kind, textures, layout in (("none", None, None), ("trained", result.textures, result.layout)):
            figures = measure_view(result.gaussians, view, textures, layout, settings)
            renders.append({"width": view.width, "height": view.height, "textures": kind, **figures})
    return {"scene": scene.name, "num": result.gaussians.num, "renders": renders}


def load_case(case: dict) -> tuple[a2tg_jax.Scene, a2tg_jax.TrainConfig]:
    """The scene, and a short training of it."""
    scene = a2tg_jax.load_scene(pathlib.Path(case["scene"]), downscale=case["downscale"])
    stage1, stage2 = case["iterations"]
    config = dataclasses.replace(
        a2tg_jax.TrainConfig.quick(),
        stage1_iterations=stage1,
        stage2_iterations=stage2,
        densify=a2tg_jax.DensifyConfig(cap=case["num"]),
    )
    return scene, config


def late_step_ms(history: a2tg_jax.History) -> float:
    """Milliseconds a step, the median over the last half of the log."""
    steps = np.diff(history.seconds) / np.diff(history.iteration)
    return float(np.median(steps[-(len(steps) // 2) :])) * 1e3
