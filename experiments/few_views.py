"""Train on few views and score views left out of the training views: does `bytewise` overfit?

    python experiments/few_views.py --scenes SCENES --out OUT

Of scenes with many training views 24 are kept, evenly spaced, and 12 to 23 of the others are scored. Scenes with fewer
than 30 are cut into five folds: every fifth view is scored. Test views are not used. The preset is `quick`, the budget
0.6 MB, the photographs are downscaled by 2; --small has photographs downscaled by 4 and 0.15 MB.

Each training is kept in OUT/few_views.json as soon as it is measured, so that a second call goes on. The table is
OUT/few_views.md. With --small both are called few_views_small.
"""

import dataclasses
import functools
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from lab import tables
from lab.interrupts import interruptible
from lab.kept import KeptFigures, parser_of

import a2tg_jax as a2tg
from a2tg_jax.host.memory import tidy_memory
from a2tg_jax.training import find_system
from a2tg_jax.training.registry import with_changes

SCENES = ("fox", "snowmiku", "lego", "herz_jesus_p25")
WHITE_BEHIND = ("lego",)
DOWNSCALE, BUDGET = 2, 0.6
"""Size of the photographs, as a divisor, and the memory budget in MB."""
SMALL_DOWNSCALE, SMALL_BUDGET = 4, 0.15
NUM_KEPT, NUM_SCORED, NUM_FOLDS = 24, 12, 5
GAUSSIAN_KERNELS = {"kernel": {"rate": 0.0}, "view_dependence": {"share": 0.23}}
WITHOUT_DETAILS = {"kernel": {"rate": 0.0}, "view_dependence": {"share": 0.0}, "texture": {"share": 0.0}}
REFERENCE = "MCMC, degree 0"
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    REFERENCE: ("gaussians-2d-mcmc", {"sh_degree": 0, "stage2_iterations": 1_000}),
    "bytewise": ("bytewise", {}),
    "bytewise, Gaussian kernels": ("bytewise", GAUSSIAN_KERNELS),
    "bytewise without details": ("bytewise", WITHOUT_DETAILS),
    "the same without pruning": ("bytewise", {**WITHOUT_DETAILS, "prune": {"share": 0.0}}),
}
SMALL_METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    **{label: METHODS[label] for label in (REFERENCE, "bytewise")},
    "floaters pruned": ("bytewise", {"floaters": {"near_share": 0.7}}),
    "jitter": ("bytewise", {"jitter": 0.1}),
}


def captures(folder: Path, downscale: int = DOWNSCALE) -> Iterator[tuple[str, a2tg.Scene]]:
    """Yield each capture of few views by name, with the scored views in place of test views."""
    for name in SCENES:
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
    scene: a2tg.Scene, name: str, method: tuple[str, dict[str, Any]], budget: float = BUDGET
) -> dict[str, float]:
    """Return the figures of one training by a system with some options."""
    known, options = method
    own = {"memory_budget": budget, **({"background": "white"} if name in WHITE_BEHIND else {})}
    system = with_changes(find_system(known).preset("quick"), {**options, **own}, name)
    start = time.perf_counter()
    model = a2tg.fit(scene, system, progress=False, session=a2tg.Session(tidy_memory)).model
    psnr, train_psnr = (a2tg.evaluate(views, model).psnr for views in (scene.test, scene.train))
    return {
        "psnr": psnr, "train_psnr": train_psnr, "num_gaussians": model.num, "views": len(scene.train),
        "seconds": time.perf_counter() - start,
    }  # fmt: skip


def table(methods: Iterable[str], found: Mapping[str, Mapping[str, float]]) -> str:
    """Return a row for each capture: PSNR of the reference, and what the others gain, on left-out / training views."""
    rows, others = [], [label for label in methods if label != REFERENCE]
    for name in dict.fromkeys(key.partition(" | ")[0] for key in found):
        base = found.get(key_of(name, REFERENCE))
        if base is None:
            continue
        gains = [_told(found.get(key_of(name, label)), base) for label in others]
        rows.append([name, f"{base['views']:g}", f"{base['psnr']:.2f} / {base['train_psnr']:.2f}", *gains])
    return tables.markdown(["capture", "training views", REFERENCE, *others], rows)


def _told(cell: Mapping[str, float] | None, base: Mapping[str, float]) -> str:
    if cell is None:
        return tables.MISSING
    return " / ".join(tables.signed(cell[figure] - base[figure], 2) for figure in ("psnr", "train_psnr"))


def key_of(name: str, label: str) -> str:
    return f"{name} | {label}"


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--scenes", type=Path, required=True, help=f"folder of {', '.join(SCENES)}")
    parser.add_argument("--small", action="store_true", help="small photographs and few bytes")
    arguments = parser.parse_args()
    a2tg.configure_cpu()
    methods = SMALL_METHODS if arguments.small else METHODS
    downscale, budget = (SMALL_DOWNSCALE, SMALL_BUDGET) if arguments.small else (DOWNSCALE, BUDGET)
    file = "few_views_small" if arguments.small else "few_views"
    kept = KeptFigures(arguments.out, file, functools.partial(table, methods))
    for name, scene in captures(arguments.scenes, downscale):
        for label, method in methods.items():
            kept.measure(key_of(name, label), functools.partial(measured, scene, name, method, budget))
    print(kept.table())


if __name__ == "__main__":
    with interruptible():
        main()
