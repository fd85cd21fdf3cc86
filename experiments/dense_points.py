"""Train every system from few and from many initial points, in budgets that they nearly fill and in ample ones.

    python experiments/dense_points.py --out OUT

The points lie on the surfaces of the built-in scene at 80×60 pixels, but for one in 500, which lies anywhere before the
cameras, as outliers of a dense reconstruction do. Budgets are multiples of the bytes of the points' Gaussians. Training
takes 200 + 100 iterations of `quick`. Figures are PSNR on the training views and on those held out: so many Gaussians
have more numbers than the photographs have pixels, and some methods fit the training views too closely.

Each training is kept in OUT/dense_points.json as soon as it is measured, so that a second call goes on. The table is
OUT/dense_points.md.
"""

import dataclasses
import functools
import time
import warnings
from collections.abc import Mapping

import numpy as np
from lab import tables
from lab.interrupts import interruptible
from lab.kept import KeptFigures, parser_of

import a2tg_jax as a2tg
from a2tg_jax.core.budget import MEGABYTE, bytes_per_gaussian
from a2tg_jax.host.machine import tidy_memory
from a2tg_jax.training import SYSTEMS, find_system

NUM_POINTS = (20_000, 100_000, 300_000)
BUDGETS = (1.05, 1.5, 4.0)
"""Times the bytes of as many Gaussians as there are points."""
ITERATIONS = {"stage1_iterations": 200, "stage2_iterations": 100}
POINTS_PER_OUTLIER = 500
LARGEST_LOSS = 1.0
"""dB by which more points may be worse than fewer at the same multiple of their bytes."""


def dense_scene(num_points: int) -> a2tg.Scene:
    """The built-in scene with so many points, some of them outliers."""
    scene = a2tg.synthetic_scene(num_points=num_points, downscale=4)
    rng = np.random.default_rng(0)
    points, num = scene.points.copy(), len(scene.points) // POINTS_PER_OUTLIER
    points[rng.choice(len(points), num, replace=False)] = rng.uniform(-1, 1, (num, 3))
    return dataclasses.replace(scene, points=points)


def measured(scene: a2tg.Scene, name: str, ratio: float) -> dict[str, float | str]:
    """One training, or the reason for which it is refused."""
    preset = find_system(name).preset("quick")
    own = bytes_per_gaussian(preset.initial_sh_degree)
    budget = ratio * own * len(scene.points) / MEGABYTE
    system = dataclasses.replace(preset, memory_budget=budget, **ITERATIONS)
    start = time.perf_counter()
    try:
        with warnings.catch_warnings(record=True) as wording:
            warnings.simplefilter("always")
            model = a2tg.fit(scene, system, progress=False, session=a2tg.Session(tidy_memory)).model
    except ValueError as error:
        return {"refused": str(error)}
    return {
        "psnr": a2tg.evaluate(scene.test, model).psnr,
        "train_psnr": a2tg.evaluate(scene.train, model).psnr,
        "num_gaussians": model.num,
        "megabytes": model.num_bytes / MEGABYTE,
        "seconds": time.perf_counter() - start,
        "warnings": " ".join(str(warning.message) for warning in wording),
    }


def table(found: Mapping[str, Mapping[str, float | str]]) -> str:
    """A row for each system and budget, a column for each number of points: training / held-out views (Gaussians)."""
    rows = []
    for name in SYSTEMS:
        for ratio in BUDGETS:
            cells = [found.get(key_of(name, num, ratio), {}) for num in NUM_POINTS]
            psnrs = [float(cell["train_psnr"]) for cell in cells if "train_psnr" in cell]
            lost = max((max(psnrs[:at]) - psnr for at, psnr in enumerate(psnrs) if at), default=0.0)
            shown = [_as_text(cell) for cell in cells]
            rows.append([name, f"{ratio:g}", *shown, f"{lost:.2f}" if lost > LARGEST_LOSS else "–"])
    return tables.markdown(
        ["system", "budget ×", *(f"{num:,} points" for num in NUM_POINTS), "lost in training, dB"], rows
    )


def _as_text(cell: Mapping[str, float | str]) -> str:
    if "train_psnr" not in cell:
        return "refused" if "refused" in cell else tables.MISSING
    return f"{cell['train_psnr']:.2f} / {cell['psnr']:.2f} ({cell['num_gaussians']:,})"


def key_of(name: str, num_points: int, ratio: float) -> str:
    return f"{name} | {num_points} | {ratio:g}"


def main() -> None:
    arguments = parser_of(__doc__).parse_args()
    a2tg.configure_cpu()
    kept = KeptFigures(arguments.out, "dense_points", table)
    for ratio in BUDGETS:
        for num in NUM_POINTS:
            wanted = {name: key_of(name, num, ratio) for name in SYSTEMS}
            if kept.has_all(wanted.values()):
                continue
            scene = dense_scene(num)
            for name, key in wanted.items():
                kept.measure(key, functools.partial(measured, scene, name, ratio))
    print(kept.table())


if __name__ == "__main__":
    with interruptible():
        main()
