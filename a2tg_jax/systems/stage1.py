"""The first stage that most systems share: plain Gaussians, densified by Monte Carlo or by adaptive density control."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

from a2tg_jax.appearance import Appearance, Plain
from a2tg_jax.densify.clone_split import CloneSplitPrune, FillingDensity, OpacityReset
from a2tg_jax.densify.pruning import Prune, during_growth
from a2tg_jax.events import Event, Times, from_options, iterations_at
from a2tg_jax.host.text import shortened
from a2tg_jax.mcmc import FillingMcmc, Mcmc, Noise
from a2tg_jax.training.options import Ranges, System
from a2tg_jax.training.rates import LearningRates
from a2tg_jax.training.stage import Stage

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
ANY_RATE = (0, math.inf)
LOOKUP_RANGES: Ranges = {"texture.lookup.max_alpha": (1e-3, 0.9999), "texture.lookup.initial_rgb": (-1.0, 1.0)}
MCMC_OPTIONS = {"Mcmc.cap": "densify.cap"}
DENSITY_OPTIONS = {
    "CloneSplitPrune.cap": "densify.cap",
    "CloneSplitPrune.threshold": "densify.threshold",
    "CloneSplitPrune.least_opacity": "densify.least_opacity",
    "CloneSplitPrune.shares_opacity": "densify.shares_opacity",
    "OpacityReset.most": "densify.reset_opacity",
}
PRUNE_OPTIONS = {"Prune.share": "prune.share", "Prune.at": "prune.at"}
"""Option that sets a field of an event (`System.event_options`)."""
PRUNE_RANGES: Ranges = {"prune.share": (0, 0.9)}
LONG_STAGE = 30_000
"""Iterations of a stage in which the times of growth are told as fractions."""
LAST_PRUNING = 0.8
"""Latest fraction of the first stage at which Gaussians are pruned; MCMC's growth ends at 5/6."""
DENSITY_RANGES: Ranges = {"densify.threshold": ANY_RATE, "densify.least_opacity": (0, 0.99)}


@dataclasses.dataclass(frozen=True)
class McmcConfig:
    """MCMC densification (3DGS-MCMC)."""

    cap: int = Mcmc.cap
    """Largest number of Gaussians; a memory_budget takes its place."""
    is_enabled: bool = True
    """Whether Gaussians relocate and grow; off: their number stays that of initial_gaussians, and cap is not used."""

    def events(self, budget_cap: int | None = None) -> tuple[Event, ...]:
        """Return the events: noise after every iteration, relocation and growth at their times.

        Args:
          budget_cap: how many Gaussians there shall be in the end; None: at most `cap`.
        """
        if budget_cap is not None:
            if not self.is_enabled:
                raise ValueError("densify.is_enabled is off, so that no Gaussians can fill a memory_budget")
            return (Noise(), FillingMcmc(budget_cap))
        if self.cap < 2:
            raise ValueError(f"densify.cap must be at least 2 Gaussians; got {self.cap}")
        return (Noise(), from_options(Mcmc, self)) if self.is_enabled else (Noise(),)


@dataclasses.dataclass(frozen=True)
class DensityConfig:
    """Adaptive density control (3DGS, 2DGS)."""

    cap: int = CloneSplitPrune.cap
    """Largest number of Gaussians and of allocated rows; a memory_budget takes its place."""
    threshold: float = CloneSplitPrune.threshold
    """Smallest average gradient that is densified, by the position on the screen in units of half an image. With a
    memory_budget the largest gradients are densified, however small."""
    least_opacity: float = CloneSplitPrune.least_opacity
    """Smallest opacity; fainter Gaussians are pruned."""
    reset_opacity: float = OpacityReset.most
    """Largest opacity after a reset, every max(500, n/10) of n iterations until n/2."""
    shares_opacity: bool = CloneSplitPrune.shares_opacity
    """Whether a Gaussian and its clone share the opacity, so that cloning makes nothing more opaque."""

    def events(self, budget_cap: int | None = None) -> tuple[Event, ...]:
        """Return the events: clone, split and prune; reset opacities.

        Args:
          budget_cap: how many Gaussians there shall be in the end; None: at most `cap`.
        """
        if self.cap < 2:
            raise ValueError(f"densify.cap must be at least 2 Gaussians; got {self.cap}")
        if not 0 < self.reset_opacity < 1:
            raise ValueError(f"densify.reset_opacity must lie between 0 and 1; got {self.reset_opacity}")
        kind, cap = (CloneSplitPrune, self.cap) if budget_cap is None else (FillingDensity, budget_cap)
        return from_options(kind, self, cap=cap), OpacityReset(self.reset_opacity)


@dataclasses.dataclass(frozen=True)
class PruneConfig:
    """Pruning of the Gaussians that show least; others grow in their place."""

    share: float = Prune.share
    """Share of the Gaussians to prune each time; 0: none. `bytewise` prunes at the end of the stage in any case."""
    at: tuple[float, ...] = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
    """Fractions of the first stage, up to 0.8. Those after the last growth are left out: in `gaussians-2d` from 0.5."""

    def events(self, num_iterations: int, growth: Callable[[int], Times]) -> tuple[Event, ...]:
        """Return the event that prunes while others grow; none if the share is 0.

        Args:
          num_iterations: length of the stage.
          growth: times of growth in a stage by its length.

        Raises:
          ValueError: if no fraction is left, though others grow.
        """
        if not self.share:
            return ()
        iterations_at(self.at, num_iterations, "prune.at")
        if not self.at or self.at[-1] > LAST_PRUNING:
            raise ValueError(
                f"prune.at must hold fractions up to {LAST_PRUNING}, after which too little grows in the place of "
                f"what is pruned; got {shortened(self.at)}: lower the last, or set prune.share to 0"
            )
        if not during_growth(self.at, LONG_STAGE, growth(LONG_STAGE)):
            ends = growth(LONG_STAGE).last_time / LONG_STAGE
            raise ValueError(
                f"prune.at must begin before the last growth, at {ends:.2g} of the stage; got {shortened(self.at)}"
            )
        times = growth(num_iterations)
        at = during_growth(self.at, num_iterations, times)
        if not at and times.num_times:
            raise ValueError(
                f"prune.at must hold a fraction before the last growth, which is at iteration {times.last_time:,} of "
                f"{num_iterations:,}; got {shortened(self.at)}: lower the first, or set prune.share to 0"
            )
        return (from_options(Prune, self, at=at),) if at else ()


NO_PRUNING = PruneConfig(share=0.0)


def growing_stage(
    system: System,
    iterations: int,
    events: tuple[Event, ...],
    appearance: Appearance = Plain(),  # noqa: B008 - frozen
    params_rate: Any = None,
    name: str = "gaussians",
) -> Stage:
    """Return a first stage, in which the degree of spherical harmonics rises and floaters are pruned; it does not cool
    down."""
    return Stage(
        name=name,
        appearance=appearance,
        events=(*events, *system.floaters.events(iterations, events)),
        losses=system.loss.terms(),
        rates=dataclasses.replace(system.rates, cooldown=0.0),
        iterations=iterations,
        params_rate=_rate_for(appearance, params_rate),
        corrections=system.corrections_of(0),
        jitter=system.jitter,
        raises_sh_degree=True,
    )


def later_stage(
    system: System,
    name: str,
    appearance: Appearance,
    events: tuple[Event, ...],
    iterations: int,
    params_rate: Any = None,
) -> Stage:
    """Return a second stage, from the result of the first, with all degrees and a fixed number of Gaussians."""
    return Stage(
        name=name,
        appearance=appearance,
        events=events,
        losses=system.loss.terms(is_first=False),
        rates=system.rates,
        iterations=iterations,
        params_rate=_rate_for(appearance, params_rate),
        corrections=system.corrections_of(1),
    )


def _rate_for(appearance: Appearance, rate: Any) -> Any:
    """Return the rate of parameters; 0 of plain splats, which have none, as records of earlier runs say."""
    return 0.0 if rate is None and type(appearance) is Plain else rate


def continued(system: System, first: Stage, iterations: int) -> tuple[Stage, ...]:
    """Return a first stage, and a second one without events if it has iterations."""
    if not iterations:
        return (dataclasses.replace(first, rates=system.rates),)
    return first, later_stage(system, "continued", first.appearance, (), iterations, first.params_rate)
