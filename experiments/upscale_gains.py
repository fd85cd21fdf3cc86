"""Gain of textures on groups of Gaussians, and the criteria that predict it.

Training continues from a model without textures, once as it is and once for each group of Gaussians, which gets 2×2
texels. The gain of a group is the PSNR that its textures add on training views. Groups are the quarters of each
criterion's order, so all have one size and take the same bytes. A criterion is good if its mean over a group ranks the
groups by their gain. Figures are kept in upscale_gains.json.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid
from lab.jobs import MOST_TRAIN_VIEWS, background_of
from lab.measured import measured_once

import a2tg_jax as a2tg
from a2tg_jax.data import view_image
from a2tg_jax.events import Change, Due, HostEvent, read_probe
from a2tg_jax.model import Model
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.renderer import plan_render
from a2tg_jax.systems.bytewise import Bytewise
from a2tg_jax.systems.two_stages import TwoStages
from a2tg_jax.training import Stage, fit_stage
from a2tg_jax.training.losses import photometric_loss

ITERATIONS, SMOKE_ITERATIONS = 300, 8
SMOKE_CRITERIA = 1
"""Number of criteria whose groups are trained at the smoke scale."""
NUM_PARTS, SMOKE_PARTS = 4, 2
"""Number of groups in a criterion's order."""
SEEDS = (0, 1, 2)
"""Seeds of training without textures, whose spread is the noise."""
SIZE = (2, 2)
CRITERIA = {
    "paper": "gradient by position (the paper's)",
    "paper_by_size": "the same, times the size",
    "texels_coherent": "gradient of RGB texels, summed over views: g²/2h",
    "texels_per_view": "norm of the gradient of RGB texels in a view, summed over views",
    "alpha_coherent": "gradient of alpha texels, summed over views",
    "alpha_per_view": "norm of the gradient of alpha texels in a view, summed over views",
    "residual": "absolute error under the splat, weighted by it",
    "coverage": "weight of the splat, summed over pixels",
}


@a2tg.pytree
class GrowRows(HostEvent):
    """Event that gives some Gaussians textures of one size after the first iteration."""

    rows: Any
    """Mask of the Gaussians that get a texture, [N] bool."""

    def iterations(self, num_iterations: int) -> tuple[int, ...]:
        return (1,)

    def apply(self, due: Due, model: Model, moments, state) -> Change:
        sizes = np.where(np.asarray(self.rows)[:, None], SIZE, (0, 0))
        grown = a2tg.reallocate(model.textures, sizes, moments)
        return Change(model.with_textures(grown.textures), grown.moments, state)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trial(TwoStages):
    """One stage that continues from a model with textures of some rows, or without textures if `rows` is None."""

    rows: Any = dataclasses.field(default=None, hash=False)
    stage2_iterations: int = ITERATIONS

    def stages(self) -> tuple[Stage, ...]:
        if self.rows is None:
            return (self.later_stage("trial", a2tg.Appearance()),)
        rates = {"texture": a2tg.TexelRates(Bytewise().texel_rate, 0.0)}
        empty = a2tg.Appearance(texture=a2tg.Texture(start=(0, 0)))
        return (self.later_stage("trial", empty, (GrowRows(self.rows),), rates),)


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write a table of rank correlations, a column a model."""
    (grid,) = grids
    found = measured_once(lab, EXPERIMENT.name, grid, _measure, first_stage=True)
    header = ["criterion", *(f"{result.run.cell.scene.label}, {result.run.cell.budget:g} MB" for result, _ in found)]
    ranks = [_rank_correlations(figures) for _, figures in found]
    rows = [[wording, *(tables.signed(own[name], 2) for own in ranks)] for name, wording in CRITERIA.items()]
    gains = [[wording, *(_quarters(figures, name) for _, figures in found)] for name, wording in CRITERIA.items()]
    num_groups = max((len(figures["groups"]) for _, figures in found), default=0)
    noise = ", ".join(f"{np.std(figures['without']):.3f}" for _, figures in found)
    parts = [
        f"# {grid.title}",
        f"Rank correlation (Spearman's) of a criterion's mean over a group with the group's gain, over "
        f"{num_groups} groups of a quarter of the Gaussians.\n\n{tables.markdown(header, rows)}",
        "## Gains by quarter\n\ndB on training views, from the quarter that a criterion ranks lowest to its highest. "
        f"The same training from other seeds differs by {noise} dB (standard deviation, without textures).\n\n"
        + tables.markdown(header, gains),
    ]
    lab.write(EXPERIMENT.name, "\n\n".join(part.strip() for part in parts) + "\n")


def _measure(lab: Lab, result: tables.Result, model: Model) -> dict[str, Any]:
    """Return scores and gain of every group."""
    scene = lab.folders.load_scene(result.run.job)
    options = result.run.job.system
    system = Trial(**{field.name: getattr(options, field.name) for field in dataclasses.fields(a2tg.System)})
    iterations = SMOKE_ITERATIONS if lab.is_smoke else ITERATIONS
    system = dataclasses.replace(system, memory_budget=None, stage2_iterations=iterations)
    seeds, num_parts = (SEEDS[:1], SMOKE_PARTS) if lab.is_smoke else (SEEDS, NUM_PARTS)
    without = [_quality(scene, model, dataclasses.replace(system, seed=seed)) for seed in seeds]
    scores = criteria(model, scene)
    groups = []
    for name in list(CRITERIA)[:SMOKE_CRITERIA] if lab.is_smoke else CRITERIA:
        order = np.argsort(scores[name], kind="stable")
        for part, rows in enumerate(np.array_split(order[: len(order) // num_parts * num_parts], num_parts)):
            mask = np.zeros(model.num, bool)
            mask[rows] = True
            train, test = _quality(scene, model, dataclasses.replace(system, rows=mask))
            means = {other: float(np.mean(scores[other][rows])) for other in CRITERIA}
            gain = {"train": train - without[0][0], "test": test - without[0][1]}
            groups.append({"criterion": name, "part": part, "scores": means, **gain})
            print(name, part, gain, flush=True)
    return {"without": [train for train, _ in without], "groups": groups}


def _quality(scene: a2tg.Scene, model: Model, system: Trial) -> tuple[float, float]:
    """Return PSNR on training views and on test views after a trial."""
    trained = fit_stage(scene, system, 0, model, progress=False).model
    train = scene.train[:: -(-len(scene.train) // MOST_TRAIN_VIEWS)]
    background = background_of(scene)
    return tuple(a2tg.evaluate(views, trained, background=background).psnr for views in (train, scene.test))


def _rank_correlations(figures: Mapping[str, Any]) -> dict[str, float]:
    gains = _ranks([group["train"] for group in figures["groups"]])
    scores = {name: _ranks([group["scores"][name] for group in figures["groups"]]) for name in CRITERIA}
    return {name: float(np.corrcoef(own, gains)[0, 1]) for name, own in scores.items()}


def _ranks(values: Sequence[float]) -> np.ndarray:
    return np.argsort(np.argsort(values))


def _quarters(figures: Mapping[str, Any], name: str) -> str:
    own = [group["train"] for group in figures["groups"] if group["criterion"] == name]
    return " ".join(tables.signed(gain, 2) for gain in own) or tables.MISSING


def criteria(model: Model, scene: a2tg.Scene) -> dict[str, np.ndarray]:
    """Return each criterion, [N], over all training views (host)."""
    textures = a2tg.allocate_textures(np.full((model.num, 2), SIZE))
    background = jnp.asarray(background_of(scene) or (0.0, 0.0, 0.0))
    own = dataclasses.replace(model, appearance=a2tg.Appearance(texture=a2tg.Texture(textures)))
    settings = plan_render(own, [view.camera for view in scene.train])
    look = jax.jit(functools.partial(_look, settings=settings))
    sums: Any = None
    for index, view in enumerate(scene.train):
        key = jax.random.key(index)
        found = look(own, view.camera, jnp.asarray(view_image(view, np.asarray(background))), background, key)
        sums = found if sums is None else jax.tree.map(jnp.add, sums, found)
    return {name: np.asarray(values) for name, values in _scores(own, sums).items()}


def _look(model: Model, camera, target: Array, background: Array, key: Array, *, settings) -> dict[str, Array]:
    """Return one view's terms of the criteria; texels are [rows, 4] in the order of the only bucket."""
    probe = jnp.zeros((model.num, 4), model.gaussians.means.dtype)

    def draw(texels: Array, probe: Array) -> Array:
        shown = model.appearance.with_textures(dataclasses.replace(model.textures, buckets=(texels,)))
        output, _ = render_traced(model.gaussians, camera, shown, background, settings, probe=probe)
        return output.color

    color, back = jax.vjp(draw, model.textures.buckets[0], probe)
    g_texels, g_probe = back(jax.grad(photometric_loss)(color, target))
    residual = color - target
    slopes, _ = back(residual)
    signs, _ = back(jax.random.rademacher(key, color.shape, color.dtype))
    weighted, _ = back(jnp.abs(residual))
    covered, _ = back(jnp.ones_like(color))
    by_position, is_seen = read_probe(g_probe, "position", camera.width, camera.height)
    norms = lambda texels: jnp.sqrt(jnp.sum(texels**2, axis=(1, 2, 3)))  # noqa: E731
    return {
        "norms": jnp.where(is_seen, jnp.linalg.norm(by_position, axis=1), 0.0), "views": is_seen.astype(jnp.float32),
        "slopes": slopes[..., :3], "squares": signs[..., :3] ** 2, "alpha": g_texels[..., 3:],
        "texels_per_view": norms(g_texels[..., :3]), "alpha_per_view": norms(g_texels[..., 3:]),
        "residual": jnp.sum(weighted[..., :3], axis=(1, 2, 3)), "coverage": jnp.sum(covered[..., :3], axis=(1, 2, 3)),
    }  # fmt: skip


def _scores(model: Model, sums: Mapping[str, Array]) -> dict[str, Array]:
    rows = model.textures.row
    average = sums["norms"] / jnp.maximum(sums["views"], 1.0)
    size = jnp.exp(jnp.mean(model.gaussians.log_scales, axis=1))
    gain = jnp.sum(sums["slopes"] ** 2 / (2 * sums["squares"] + 1e-3), axis=(1, 2, 3))
    by_row = {
        "texels_coherent": gain,
        "alpha_coherent": jnp.sqrt(jnp.sum(sums["alpha"] ** 2, axis=(1, 2, 3))),
        **{name: sums[name] for name in ("texels_per_view", "alpha_per_view", "residual", "coverage")},
    }
    return {"paper": average, "paper_by_size": average * size, **{name: own[rows] for name, own in by_row.items()}}


EXPERIMENT = Experiment("upscale_gains", ("upscale_gains",), present, __doc__)
