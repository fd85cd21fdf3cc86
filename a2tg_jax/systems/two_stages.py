"""What the systems of this library share: a first stage that grows, a second one with a fixed number of Gaussians."""

import dataclasses
from typing import Any, NamedTuple, Self, TypeVar

import jax.numpy as jnp

from a2tg_jax.appearance import Appearance, Exponents
from a2tg_jax.appearance.parts import shapes_of
from a2tg_jax.base.checks import check_fields
from a2tg_jax.base.text import shortened
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import pytree
from a2tg_jax.densify.clone_split import CloneSplitPrune, FillingDensity
from a2tg_jax.densify.pruning import Prune, PruneFloaters
from a2tg_jax.events import Change, Event, Now, StepEvent, Times
from a2tg_jax.mcmc import FillingMcmc, Mcmc, Noise
from a2tg_jax.model import Model
from a2tg_jax.training.options import System
from a2tg_jax.training.stage import LearningRates, Stage

P = TypeVar("P", Prune, PruneFloaters)
QUICK_CAP = 10_000
QUICK_OPACITY = 0.5
QUICK_RATES = LearningRates(means=3 * 1.6e-4, sh_degree0=2 * 2.5e-3)
QUICK_TEXELS = 1e-2
"""Options of short runs (docs/results.md): Gaussians that begin half opaque, and faster rates."""
QUICK: dict[str, Any] = {
    "stage1_iterations": 2_000, "stage2_iterations": 1_000, "initial_opacity": QUICK_OPACITY, "rates": QUICK_RATES,
}  # fmt: skip
SMOKE: dict[str, Any] = {
    "stage1_iterations": 200, "initial_gaussians": 800, "initial_opacity": QUICK_OPACITY, "rates": QUICK_RATES,
}  # fmt: skip
SMOKE_CAP = 1_000
FLOATS_PER_TEXEL = 4
# Chosen in experiments/NOTEBOOK.md, "The parts of bytewise".
PRUNING = Prune(at=(0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8))
NO_PRUNING = dataclasses.replace(PRUNING, share=0.0)
LAST_PRUNING = 0.8
"""Latest fraction of the first stage at which Gaussians are pruned, because MCMC's growth ends at 5/6."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwoStages(System):
    """A first stage in which the Gaussians grow and floaters are pruned, and a second one."""

    stage1_iterations: int = 30_000
    """Iterations of the first stage."""
    stage2_iterations: int = 30_000
    """Iterations of the second stage."""
    coarse_share: float = 0.0
    """Share of the first stage, from its beginning, with photographs of half the width and height, which take less
    time; 0: none. Photographs of less than 128 pixels stay whole."""
    floaters: PruneFloaters = PruneFloaters(min_views=0)
    """Pruning of floaters in the first stage."""

    def check_options(self) -> None:
        super().check_options()
        check_fields(self, "coarse_share", least=0, most=1)

    @classmethod
    def short_presets(cls, quick: dict[str, Any], smoke: dict[str, Any]) -> dict[str, Self]:
        """Return the presets "paper", "quick" and "smoke", given the options in which short runs of a system differ."""
        return {"paper": cls(), "quick": cls(**(QUICK | quick)), "smoke": cls(**(SMOKE | smoke))}

    def growing_stage(
        self,
        events: tuple[Event, ...],
        appearance: Appearance = Appearance(),  # noqa: B008 - frozen
        appearance_rate: object = None,
        name: str = "gaussians",
    ) -> Stage:
        """Return a first stage, in which the degree of spherical harmonics rises and floaters are pruned."""
        floaters = self.floaters
        length = self.stage1_iterations
        if floaters.min_views or floaters.near:
            growths = [event.times(length) for event in events if event.most_gaussians is not None]
            growths = [times for times in growths if times]
            if growths:
                latest = max(growths, key=lambda times: times[-1])
                floaters = _before_last_growth(floaters, "floaters", length, latest)
            events = (*events, floaters)
        return Stage(
            name, appearance, events, self.loss.terms(), self.rates, length, appearance_rate, self.corrections_of(0),
            raises_sh_degree=True, num_coarse=round(self.coarse_share * length),
        )  # fmt: skip

    def later_stage(
        self, name: str, appearance: Appearance, events: tuple[Event, ...] = (), appearance_rate: object = None
    ) -> Stage:
        """Return a second stage, from the result of the first, with all degrees and a fixed number of Gaussians."""
        losses = self.loss.terms(is_first=False)
        length = self.stage2_iterations
        return Stage(name, appearance, events, losses, self.rates, length, appearance_rate, self.corrections_of(1))

    def continued(self, first: Stage) -> tuple[Stage, ...]:
        """Return a first stage, and a second one without events if it has iterations."""
        if not self.stage2_iterations:
            return (first,)
        return first, self.later_stage("continued", first.appearance, appearance_rate=first.appearance_rate)


@pytree
class LimitExponents(StepEvent):
    """Lower limit of the exponents of kernels (`Appearance.exponents`), after every iteration."""

    least: float = 0.6  # an opaque kernel reaches 5.7σ, and 11.7σ at 1/e (experiments/NOTEBOOK.md)
    """Smallest exponent of a kernel, 0 to 1. Smaller ones have longer tails, which take longer to draw; up to 1/e it
    limits nothing."""

    num_keys = 0

    def check_options(self) -> None:
        check_fields(self, "least", least=0, most=1)

    def apply(self, now: Now, model: Model, moments: AdamState, state: tuple[()]) -> Change:
        shapes = model.appearance.shapes
        if shapes is None:
            raise ValueError("LimitExponents needs kernels with exponents, such as Appearance(exponents=Exponents())")
        least = shapes_of(jnp.log(jnp.asarray(self.least, shapes.dtype)))
        appearance = model.appearance.with_shapes(jnp.maximum(shapes, least))
        return Change(dataclasses.replace(model, appearance=appearance), moments, state)


class Kernels(NamedTuple):
    """What trainable shapes of kernels add to each stage; nothing if all kernels are Gaussians."""

    part: Exponents | None
    """Part of the appearance."""
    rates: dict[str, Any]
    """Learning rate of the part, by its name."""
    limits: tuple[Event, ...]
    """Events after all others."""


def kernels_of(rate: float | None, exponents: LimitExponents) -> Kernels:
    """Return what kernels whose shapes learn at a rate add; 0 or None: all kernels are Gaussians."""
    if not rate:
        return Kernels(None, {}, ())
    return Kernels(Exponents(), {"exponents": rate}, (exponents,) if exponents.least else ())


def grown_by_mcmc(densify: Mcmc, budget_cap: int | None) -> tuple[Event, ...]:
    """Return noise after every iteration, and relocation and growth at their times, up to the number of Gaussians that
    fill the memory budget; None without one."""
    if not densify.cap:
        if budget_cap is not None:
            raise ValueError("densify.cap is 0, so that no Gaussians can fill a memory_budget")
        return (Noise(),)
    return Noise(), densify if budget_cap is None else FillingMcmc(budget_cap)


def grown_by_density(densify: CloneSplitPrune, budget_cap: int | None) -> CloneSplitPrune:
    """Return adaptive density control; parameters as in `grown_by_mcmc`."""
    if budget_cap is None:
        return densify
    options = {field.name: getattr(densify, field.name) for field in dataclasses.fields(densify)}
    return FillingDensity(**options | {"cap": budget_cap})


def pruned(prune: Prune, num_iterations: int, growth: Times) -> tuple[Event, ...]:
    """Return the event that prunes while others grow; none if its share is 0 or nothing grows.

    `growth` is the times of growth in a stage of that length.

    Raises:
      ValueError: if no fraction is left, though others grow.
    """
    if prune.keep is None and not prune.share:
        return ()
    if not prune.at or prune.at[-1] > LAST_PRUNING:
        raise ValueError(
            f"prune.at must hold fractions up to {LAST_PRUNING}, after which too little replaces what is pruned; got "
            f"{shortened(prune.at)}: lower the last, or set prune.share to 0"
        )
    return (_before_last_growth(prune, "prune", num_iterations, growth),) if growth else ()


def _before_last_growth(event: P, name: str, num_iterations: int, growth: Times) -> P:
    """Return an event that prunes at its fractions of a stage before the last growth. ValueError: there are none."""
    at = tuple(fraction for fraction in event.at if round(fraction * num_iterations) < growth[-1])
    if not at:
        raise ValueError(
            f"{name}.at must hold a fraction before the last growth, which is at iteration {growth[-1]:,} of "
            f"{num_iterations:,}; got {shortened(event.at)}: lower the first, because others replace what is pruned"
        )
    return dataclasses.replace(event, at=at)
