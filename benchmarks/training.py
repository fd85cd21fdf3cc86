"""Training steps on a real scene."""

import dataclasses
import pathlib

import numpy as np

import a2tg_jax
from a2tg_jax import A2tg
from a2tg_jax.mcmc import Mcmc
from a2tg_jax.systems.baselines import Gaussians2dMcmc
from a2tg_jax.training import fit_stage, like


def measure_training(case: dict) -> dict:
    """Measure warm steps of both stages: median milliseconds of the last ones, without compilation."""
    scene = a2tg_jax.load_scene(pathlib.Path(case["scene"]), downscale=case["downscale"])
    stage1, stage2 = case["iterations"]
    textured = dataclasses.replace(
        A2tg.preset("quick"),
        stage1_iterations=stage1,
        stage2_iterations=stage2,
        densify=Mcmc(cap=case["num"]),
    )
    plain = like(Gaussians2dMcmc, textured)
    first = fit_stage(scene, textured, 0)
    height, width = scene.train[0].picture.size
    return {
        "scene": scene.name,
        "image": [width, height],
        "num_live": first.model.num,
        "stage1_ms": late_step_ms(first.history),
        "untextured_ms": late_step_ms(fit_stage(scene, plain, 1, first.model).history),
        "textured_ms": late_step_ms(fit_stage(scene, textured, 1, first.model).history),
    }


def late_step_ms(history: a2tg_jax.History) -> float:
    """Return milliseconds a step, the median over the last half of the log."""
    steps = np.diff(history.seconds) / np.diff(history.iteration)
    return float(np.median(steps[-(len(steps) // 2) :])) * 1e3
