"""Train on few views and score views left out of the training views: does `bytewise` overfit?

    python experiments/few_views.py --scenes SCENES --out OUT [--seed 1] [--only herz_jesus_p25]

Of scenes with many training views 24 are kept, evenly spaced, and 12 to 23 of the others are scored. Scenes with fewer
than 30 are cut into five folds: every fifth view is scored. Test views are not used. The preset is `quick`, the budget
0.6 MB, the photographs are downscaled by 2; --small has photographs downscaled by 4 and 0.15 MB.

Each training is kept in OUT/few_views.json as soon as it is measured, so that a second call goes on. The table, means
of the seeds that were measured for a cell and its reference, is OUT/few_views.md. With --small both are called
few_views_small.
"""

import dataclasses
import functools
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lab import tables
from lab.interrupts import interruptible
from lab.kept import KeptFigures, parser_of

import a2tg_jax as a2tg
from a2tg_jax.host.machine import tidy_memory
from a2tg_jax.io.config_json import changed_config
from a2tg_jax.training import find_system

SCENES = ("fox", "snowmiku", "lego", "herz_jesus_p25")
WHITE_BEHIND = ("lego",)
DOWNSCALE, BUDGET = 2, 0.6
"""Size of the photographs, as a divisor, and the memory budget in MB."""
SMALL_DOWNSCALE, SMALL_BUDGET = 4, 0.15
NUM_KEPT, NUM_SCORED, NUM_FOLDS = 24, 12, 5
FIGURES = "psnr", "train_psnr"
MOST_SEEDS = 10
GAUSSIAN_KERNELS = {"kernel_rate": 0.0, "view_dependence_share": 0.23}
WITHOUT_DETAILS = {"kernel_rate": 0.0, "view_dependence_share": 0.0, "texture_share": 0.0}
REFERENCE = "MCMC, degree 0"
_PLAIN = {"sh_degree": 0, "stage2_iterations": 1_000}
PLAIN: dict[str, tuple[str, dict[str, Any]]] = {
    REFERENCE: ("gaussians-2d-mcmc", _PLAIN),
    "MCMC, degree 0, pruned": ("gaussians-2d-mcmc", {**_PLAIN, "prune": {"share": 0.1}}),
    "clone and split, degree 0": ("gaussians-2d", _PLAIN),
    "clone and split, degree 0, pruned": (
        "gaussians-2d", {**_PLAIN, "prune": {"share": 0.1, "at": [0.2, 0.25, 0.3, 0.35, 0.4, 0.45]}},
    ),
}  # fmt: skip
"""Plain Gaussians of one colour, as grids/methods.toml has them."""
POINT_DEPTHS = "depths of points"
"""Method for captures whose reconstruction tells which points a photograph saw."""
BYTEWISE: dict[str, tuple[str, dict[str, Any]]] = {
    "bytewise": ("bytewise", {}),
    POINT_DEPTHS: ("bytewise", {"loss": {"points_weight": 0.1}}),
}
PARTS: dict[str, tuple[str, dict[str, Any]]] = {
    "bytewise, Gaussian kernels": ("bytewise", GAUSSIAN_KERNELS),
    "bytewise without details": ("bytewise", WITHOUT_DETAILS),
    "the same without pruning": ("bytewise", {**WITHOUT_DETAILS, "prune": {"share": 0.0}}),
}
METHODS = {**PLAIN, **BYTEWISE, **PARTS}
SMALL_METHODS = {**PLAIN, **BYTEWISE}


Capture = tuple[str, a2tg.Scene]


def captures(folder: Path, downscale: int = DOWNSCALE, names: Iterable[str] = SCENES) -> Iterator[Capture]:
    """Yield each capture of few views of some scenes by name, with the scored views in place of test views."""
    for name in names:
        scene = a2tg.load_scene(folder / name, downscale=downscale)
        num = len(scene.train)
        if num < 30:
            for fold in range(NUM_FOLDS):
                yield f"{name}, fold {fold + 1}", _split(scene, list(range(fold, num, NUM_FOLDS)), None)
            continue
        kept = {round(index * (num - 1) / (NUM_KEPT - 1)) for index in range(NUM_KEPT)}
        others = [index for index in range(num) if index not in kept]
        yield name, _split(scene, others[:: max(1, len(others) // NUM_SCORED)], sorted(kept))


def _split(scene: a2tg.Scene, scored: list[int], kept: list[int] | None) -> a2tg.Scene:
    """Return the scene with some training views to train on, all but the scored ones if None, and some to score."""
    kept = [index for index in range(len(scene.train)) if index not in scored] if kept is None else kept
    train, test = (tuple(scene.train[index] for index in found) for found in (kept, scored))
    return dataclasses.replace(scene, train=train, test=test)


def measured(
    scene: a2tg.Scene, name: str, method: tuple[str, dict[str, Any]], budget: float = BUDGET, seed: int = 0
) -> dict[str, float]:
    """Return the figures of one training by a system with some options."""
    known, options = method
    own = {"memory_budget": budget, "seed": seed, **({"background": "white"} if name in WHITE_BEHIND else {})}
    system = changed_config(find_system(known).preset("quick"), {**options, **own}, name)
    start = time.perf_counter()
    model = a2tg.fit(scene, system, progress=False, session=a2tg.Session(tidy_memory)).model
    psnr, train_psnr = (a2tg.evaluate(views, model).psnr for views in (scene.test, scene.train))
    return {
        "psnr": psnr, "train_psnr": train_psnr, "num_gaussians": model.num, "views": len(scene.train),
        "seconds": time.perf_counter() - start,
    }  # fmt: skip


def table(methods: Iterable[str], found: Mapping[str, Mapping[str, float]]) -> str:
    """Return a row for each capture, and one for all folds of a scene: figures of the reference, then gains over it.

    Figures are on left-out / training views, means over the seeds of a capture, then over the folds. Gains are means
    over the seeds that both methods have.
    """
    by_scene = sorted({key.partition(" | ")[0] for key in found})
    names = sorted(by_scene, key=lambda name: SCENES.index(name.partition(",")[0]))
    rows = {name: [name] for name in names}
    for scene in SCENES:
        folds = [name for name in names if name.startswith(f"{scene}, fold ")]
        if len(folds) == NUM_FOLDS:
            rows[f"{scene}, mean of folds"] = folds
    others = [label for label in methods if label != REFERENCE]
    gains = {name: {label: _gain(found, own, label) for label in others} for name, own in rows.items()}
    shown = [label for label in others if any(own[label] is not None for own in gains.values())]
    wording = []
    for name, own in rows.items():
        views = _mean([found[key] for key in _keys(own[0], REFERENCE) if key in found], ("views",))
        num = tables.MISSING if views is None or len(own) > 1 else f"{views[0]:g}"
        reference = _as_text(_figures(found, own, REFERENCE), "{:.2f}")
        wording.append([name, num, reference, *(_as_text(gains[name][label], "{:+.2f}") for label in shown)])
    return tables.markdown(["capture", "training views", REFERENCE, *shown], wording)


def _figures(found: Mapping[str, Mapping[str, float]], names: Iterable[str], label: str) -> np.ndarray | None:
    """Return the means of `FIGURES` over the seeds of each capture, then over captures; None if one is missing."""
    means = [_mean([found[key] for key in _keys(name, label) if key in found]) for name in names]
    return None if any(mean is None for mean in means) else np.mean(means, axis=0)


def _gain(found: Mapping[str, Mapping[str, float]], names: Iterable[str], label: str) -> np.ndarray | None:
    """Return what a method gains over the reference, over seeds that both have; None if a capture has none."""
    gains = []
    for name in names:
        pairs = zip(_keys(name, label), _keys(name, REFERENCE), strict=True)
        both = [pair for pair in pairs if found.keys() >= set(pair)]
        own, base = (_mean([found[pair[place]] for pair in both]) for place in (0, 1))
        if own is None or base is None:
            return None
        gains.append(own - base)
    return np.mean(gains, axis=0)


def _mean(cells: Sequence[Mapping[str, float]], figures: Sequence[str] = FIGURES) -> np.ndarray | None:
    """Return the means of some figures; None of no cells."""
    return np.mean([[cell[figure] for figure in figures] for cell in cells], axis=0) if cells else None


def _as_text(figures: np.ndarray | None, form: str) -> str:
    return tables.MISSING if figures is None else " / ".join(map(form.format, figures))


def key_of(name: str, label: str, seed: int = 0) -> str:
    return f"{name} | {label}" + (f" | seed {seed}" if seed else "")


def _keys(name: str, label: str) -> list[str]:
    return [key_of(name, label, seed) for seed in range(MOST_SEEDS)]


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--scenes", type=Path, required=True, help=f"folder of {', '.join(SCENES)}")
    parser.add_argument("--small", action="store_true", help="small photographs and few bytes")
    parser.add_argument("--seed", type=int, default=0, choices=range(MOST_SEEDS), help="seed of the trainings")
    parser.add_argument("--only", action="append", choices=SCENES, help="scene to train on; may be repeated")
    parser.add_argument("--method", action="append", metavar="LABEL", help="method to train, of all; may be repeated")
    arguments = parser.parse_args()
    a2tg.configure_cpu()
    methods = SMALL_METHODS if arguments.small else METHODS
    if unknown := set(arguments.method or ()) - methods.keys():
        parser.error(f"there is no method {', '.join(sorted(unknown))}; there are {', '.join(methods)}")
    downscale, budget = (SMALL_DOWNSCALE, SMALL_BUDGET) if arguments.small else (DOWNSCALE, BUDGET)
    file = "few_views_small" if arguments.small else "few_views"
    kept, seed = KeptFigures(arguments.out, file, functools.partial(table, methods)), arguments.seed
    for name, scene in captures(arguments.scenes, downscale, arguments.only or SCENES):
        for label in arguments.method or methods:
            method = methods[label]
            if label == POINT_DEPTHS and all(view.points is None for view in scene.train):
                continue
            kept.measure(key_of(name, label, seed), functools.partial(measured, scene, name, method, budget, seed))
    print(kept.table())


if __name__ == "__main__":
    with interruptible():
        main()
