"""Measure the options for scenes in the wild on the built-in scene, spoilt on purpose in ways that are known.

    python experiments/wild.py --out OUT [--only 'distractors;few views']
    python experiments/wild.py --out OUT --capture SCENE

Each spoilt capture is trained with and without the option that should help, and the whole capture, too, to see what the
option costs where nothing is wrong. Scores are PSNR on views left out of training, whose photographs are unspoilt. With
--capture the options are compared on a real capture, of which every fourth view is left out.

Each training is kept in OUT/wild.json as soon as it is measured, so that a second call goes on. The table is
OUT/wild.md.
"""

import dataclasses
import functools
import itertools
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lab import tables
from lab.interrupts import interruptible
from lab.kept import KeptFigures, parser_of
from lab.outdoors import outdoors

import a2tg_jax as a2tg
from a2tg_jax.data.synthetic import exact_depths
from a2tg_jax.host.machine import tidy_memory
from a2tg_jax.io.config_json import changed_config

SIZE = 128, 96
OPTIONS = {"stage1_iterations": 800, "stage2_iterations": 0, "densify": {"cap": 2_500}}
SMALL, SHORT = (64, 48), {"stage1_iterations": 500, "densify": {"cap": 1_000}}
"""Image size and options of the captures with a sky."""
SEEDS = 0, 1
"""Seeds of the trainings; the captures are the same."""
NUM_FEW, NUM_FLOATERS = 6, 400
FLOATER_DEPTHS = 0.08, 0.3
"""Least and largest depth of floaters, in units of the normalised world."""


def whole(width: int = SIZE[0]) -> a2tg.Scene:
    """Return the unspoilt capture."""
    return a2tg.synthetic_scene(width=width, height=width * SIZE[1] // SIZE[0])


def few_views() -> a2tg.Scene:
    """Return the capture with a quarter of its training views, evenly spaced."""
    scene = whole()
    return dataclasses.replace(scene, train=scene.train[2 :: len(scene.train) // NUM_FEW])


def distractors() -> a2tg.Scene:
    """Return the capture with two to four striped ellipses painted into each training photograph."""
    rng = np.random.default_rng(0)
    return painted(whole(), lambda index, image: with_ellipses(image, rng))


def masked() -> a2tg.Scene:
    """Return the capture with distractors and exact masks of them, which no photographer has."""
    pairs = zip(distractors().train, whole().train, strict=True)
    views = [dataclasses.replace(a, mask=(a.image == b.image).all(axis=-1)) for a, b in pairs]
    return dataclasses.replace(whole(), train=tuple(views))


def with_ellipses(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return an image [H, W, 3] uint8 with ellipses of two random colours at random places."""
    image, (height, width) = image.copy(), image.shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    for _ in range(rng.integers(2, 5)):
        center, radii, angle = rng.uniform(0, (width, height)), rng.uniform(0.06, 0.18, 2) * width, rng.uniform(0, 3)
        u = (x - center[0]) * np.cos(angle) + (y - center[1]) * np.sin(angle)
        v = (y - center[1]) * np.cos(angle) - (x - center[0]) * np.sin(angle)
        stripes = np.where((np.sin(u / 3) > 0)[..., None], *rng.integers(0, 256, (2, 3)))
        is_inside = (u / radii[0]) ** 2 + (v / radii[1]) ** 2 < 1
        image[is_inside] = stripes[is_inside]
    return image


def processed() -> a2tg.Scene:
    """Return the capture with corners of each training photograph made darker or brighter, and shadows lifted or
    lowered on one side of it; on average over the photographs, nothing is changed."""
    rng = np.random.default_rng(0)
    return painted(whole(), lambda index, image: tone_mapped(image, rng))


def tone_mapped(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return an image [H, W, 3] uint8 with a vignette, and a gamma that changes from one side to the other."""
    height, width = image.shape[:2]
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    direction, strength, gamma = rng.uniform(0, 2 * np.pi), rng.uniform(-0.25, 0.25), np.exp(rng.uniform(-0.4, 0.4))
    side = np.clip(0.5 + 0.5 * (x * np.cos(direction) + y * np.sin(direction)), 0, 1)
    exponent = (1 + (gamma - 1) * side)[..., None]
    mapped = (image / 255) ** exponent * (1 - strength * (x * x + y * y))[..., None]
    changed: np.ndarray = np.rint(255 * np.clip(mapped, 0, 1)).astype(np.uint8)
    return changed


def few_points() -> a2tg.Scene:
    """Return the small capture with a sixth of its points, so that parts of the room are without any."""
    scene = whole(SMALL[0])
    return dataclasses.replace(scene, points=scene.points[::6], colors=scene.colors[::6])


def real(path: Path) -> a2tg.Scene:
    """Return a real capture, downscaled until it is hardly wider than `CAPTURE_WIDTH`."""
    width = a2tg.load_scene(path).train[0].camera.width
    return a2tg.load_scene(path, downscale=max(1, width // CAPTURE_WIDTH), test_every=CAPTURE_EVERY)


def painted(scene: a2tg.Scene, change: Callable[[int, np.ndarray], np.ndarray]) -> a2tg.Scene:
    """Return the scene with changed training photographs."""
    views = [dataclasses.replace(view, picture=change(index, view.image)) for index, view in enumerate(scene.train)]
    return dataclasses.replace(scene, train=tuple(views))


def with_floaters() -> a2tg.Scene:
    """Return the capture of few views whose points include grey ones close before its cameras."""
    scene, rng = few_views(), np.random.default_rng(0)
    near = np.concatenate([before(view.camera, NUM_FLOATERS // NUM_FEW, rng) for view in scene.train])
    points, colors = np.concatenate([scene.points, near]), np.concatenate([scene.colors, np.full_like(near, 0.5)])
    return dataclasses.replace(scene, points=points.astype(np.float32), colors=colors.astype(np.float32))


def before(camera: a2tg.Camera, num: int, rng: np.random.Generator) -> np.ndarray:
    """Return points [num, 3] close before a camera, within its picture."""
    pixels = np.concatenate([rng.uniform(0, SIZE, (num, 2)), np.ones((num, 1))], axis=1)
    rays = pixels @ np.linalg.inv(np.asarray(camera.K, np.float64)).T * rng.uniform(*FLOATER_DEPTHS, (num, 1))
    viewmat = np.asarray(camera.viewmat, np.float64)
    points: np.ndarray = (rays - viewmat[:3, 3]) @ viewmat[:3, :3]
    return points


def with_depths(scene: a2tg.Scene) -> a2tg.Scene:
    """Return a capture with exact maps of inverse depth, of another scale and shift in each view."""
    rng = np.random.default_rng(0)
    maps = [rng.uniform(0.5, 2) / depth + rng.uniform(-0.3, 0.3) for depth in exact_depths(scene)]
    views = [dataclasses.replace(view, depth=each) for view, each in zip(scene.train, maps, strict=True)]
    return dataclasses.replace(scene, train=tuple(views))


def depth_weight(weight: float) -> dict[str, Any]:
    """Return the options of depth priors of this weight."""
    return {"loss": {"depth_weight": weight}}


ROBUST = {"loss": {"robust_share": 0.3}}
FLOATERS: dict[str, dict[str, Any]] = {
    f"{name} {value}": {"floaters": {name: value}} for name, value in {"min_views": 2, "near": 0.3}.items()
}
GRID = {"exposure": True, "corrections": {"exposure_kind": "grid"}}
POINTS = {f"points_weight {weight}": {"loss": {"points_weight": weight}} for weight in (0.1, 0.3)}
CASES: dict[str, tuple[Callable[[], a2tg.Scene], dict[str, dict[str, Any]]]] = {
    "whole": (whole, {"plain": {}, "robust": ROBUST, "grid": GRID, **FLOATERS, **POINTS}),
    "distractors": (distractors, {"plain": {}, "robust": ROBUST}),
    "distractors, exact masks": (masked, {"plain": {}}),
    "floaters": (with_floaters, {"plain": {}, **FLOATERS}),
    "few views": (few_views, {"plain": {}, **FLOATERS, **POINTS}),
    "few views, depths": (lambda: with_depths(few_views()), {f"depth_weight {weight}": depth_weight(weight)
                                                             for weight in (0.1, 0.3, 1)}),
    "whole, depths": (lambda: with_depths(whole()), {"depth_weight 0.3": depth_weight(0.3)}),
    "outdoors": (lambda: outdoors(*SMALL), {
        "plain": SHORT, "background random": {**SHORT, "background": "random"},
        "background white": {**SHORT, "background": "white"},
        **{f"sky_gaussians {num}": {**SHORT, "sky_gaussians": num} for num in (100, 250, 500)},
    }),
    "few points": (few_points, {"plain": SHORT, "sky_gaussians 250": {**SHORT, "sky_gaussians": 250}}),
    "processed": (processed, {"plain": {}, "affine": {"exposure": True}, "grid": GRID}),
}  # fmt: skip
"""Captures and, for each, the options to compare."""


SKY_1000 = {"sky_gaussians": 1_000}
OF_CAPTURES: dict[str, dict[str, Any]] = {
    "plain": {}, "background white": {"background": "white"}, "sky_gaussians 1000": SKY_1000,
    "affine": {"exposure": True}, "sky_gaussians 1000, affine": {**SKY_1000, "exposure": True},
    "min_views 2": {"floaters": {"min_views": 2}}, "robust": ROBUST,
}  # fmt: skip
"""Options that are compared on a real capture, with `LARGER`."""
LARGER = {"stage1_iterations": 2_000, "densify": {"cap": 6_000}}
CAPTURE_WIDTH, CAPTURE_EVERY = 280, 4
"""Least width of the photographs of a real capture, and which of its views are left out."""

SIZES = "other sizes"
SIZE_FIGURES = "psnr", "psnr_supersampled", "psnr_trained_there"
SEEN_AT = (16, 32, 64, 128, 256)
"""Widths at which the model trained at the middle one is seen."""


def measure_sizes(kept: KeptFigures, session: a2tg.Session) -> None:
    """Measure how one model is seen at other widths."""
    model_of = functools.cache(lambda width: trained(whole(width), {}, session))
    for width in SEEN_AT:
        kept.measure(f"{SIZES} | {width} wide", functools.partial(seen_at, width, model_of))


def seen_at(width: int, model_of: Callable[[int], a2tg.Model]) -> dict[str, float]:
    """Return the figures of a model at another width: as it is, supersampled, and of a model trained there."""
    base, test = SEEN_AT[len(SEEN_AT) // 2], whole(width).test
    settings = a2tg.RenderSettings(supersample=max(1, base // width))
    return {
        "psnr": a2tg.evaluate(test, model_of(base)).psnr,
        "psnr_supersampled": a2tg.evaluate(test, model_of(base), settings=settings).psnr,
        "psnr_trained_there": a2tg.evaluate(test, model_of(width)).psnr,
    }


def trained(scene: a2tg.Scene, options: Mapping[str, Any], session: a2tg.Session) -> a2tg.Model:
    """Return the model of one training."""
    system = changed_config(a2tg.find_system("gaussians-2d-mcmc").preset("quick"), {**OPTIONS, **options}, "wild")
    return a2tg.fit(scene, system, progress=False, session=session).model


def measured(scene: a2tg.Scene, options: Mapping[str, Any], session: a2tg.Session) -> dict[str, float]:
    """Return the figures of one training."""
    start = time.perf_counter()
    model = trained(scene, options, session)
    return {
        "psnr": a2tg.evaluate(scene.test, model).psnr,
        "psnr_color_fit": a2tg.evaluate(scene.test, model, fit_colors=True).psnr,
        "num_gaussians": model.num, "seconds": time.perf_counter() - start,
    }  # fmt: skip


def table(found: Mapping[str, Mapping[str, float]]) -> str:
    """Return a row for each capture and its options, and one for each size at which one model is seen."""
    rows, sizes = [], []
    for key in dict.fromkeys(key.rpartition(" | seed ")[0] for key in found if " | seed " in key):
        cells = [found[f"{key} | seed {seed}"] for seed in SEEDS if f"{key} | seed {seed}" in found]
        means = [np.mean([cell[figure] for cell in cells]) for figure in ("psnr", "psnr_color_fit")]
        apart = ", ".join(f"{cell['psnr']:.2f}" for cell in cells)
        rows.append([*key.split(" | "), *(f"{mean:.2f}" for mean in means), apart])
    for key, cell in found.items():
        if key.startswith(SIZES):
            sizes.append([key.partition(" | ")[2], *(f"{cell[figure]:.2f}" for figure in SIZE_FIGURES)])
    first = tables.markdown(["capture", "options", "PSNR", "after a colour fit", "seeds"], rows)
    return f"{first}\n{tables.markdown(['seen at', 'as it is', 'supersampled', 'trained there'], sizes)}"


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--only", default=";".join((*CASES, SIZES)), help="captures, with semicolons between them")
    parser.add_argument("--capture", type=Path, help="scene folder of a real capture, in place of --only")
    arguments = parser.parse_args()
    a2tg.configure_cpu()
    kept, session = KeptFigures(arguments.out, "wild", table), a2tg.Session(tidy_memory)
    cases, names = CASES, arguments.only.split(";")
    if arguments.capture is not None:
        larger = {label: {**LARGER, **options} for label, options in OF_CAPTURES.items()}
        cases, names = {"real": (functools.partial(real, arguments.capture), larger)}, ["real"]
    for name in names:
        if name == SIZES:
            measure_sizes(kept, session)
            continue
        make, compared = cases[name]
        scene = make()
        for label, seed in itertools.product(compared, SEEDS):
            options = {**compared[label], "seed": seed}
            kept.measure(f"{name} | {label} | seed {seed}", functools.partial(measured, scene, options, session))
    print(kept.table())


if __name__ == "__main__":
    with interruptible():
        main()
