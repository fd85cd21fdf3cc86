"""Records, cells and results of experiments as tests make them up."""

import dataclasses

from lab import tables
from lab.grid import Cell, Grid, Method, Run
from lab.jobs import Job
from lab.scenes import SceneAt

import a2tg_jax as a2tg


def record(psnr=25.0, mb=1.0, num=1_000, **others):
    figures = {"ssim": 0.8, "lpips": 0.2, "pixels": [20, 10], "stage": "gaussians", "downscale": 2, "ms_per_step": 10.0}
    figures["train_psnr"] = psnr + 1
    return {"psnr": psnr, "mb": mb, "num": num, **figures, **others}


CELL = Cell(SceneAt("fox", "fox", 2), 100, 0, (10, 10))
GRID = Grid("x", "X", "small", "quick", (CELL,), Method("own", "a2tg"), (), ())


def result(label, psnr, seed=0, equal="", **others):
    job = Job("fox", 2, a2tg.A2tg(), 0)
    run = Run(Method(label, "a2tg"), dataclasses.replace(CELL, seed=seed), equal, job)
    return tables.Result(run, record(psnr, **others))
