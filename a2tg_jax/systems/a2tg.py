"""A²TG: plain Gaussians first, then textures that grow where the gradient is large (arXiv 2026, §3)."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

from a2tg_jax.adapt import Upscale, UpscaleChoices
from a2tg_jax.appearance import Plain, TexelRates, Textured, TextureOptions
from a2tg_jax.core.budget import MEGABYTE, bytes_per_gaussian, megabytes_of
from a2tg_jax.events import Statistic, from_options
from a2tg_jax.mcmc import Mcmc, Noise
from a2tg_jax.systems.stage1 import (
    ANY_RATE,
    FLOATS_PER_TEXEL,
    LOOKUP_RANGES,
    MCMC_OPTIONS,
    QUICK_CAP,
    QUICK_OPACITY,
    QUICK_RATES,
    QUICK_TEXELS,
    SMOKE,
    SMOKE_CAP,
    McmcConfig,
    growing_stage,
    later_stage,
)
from a2tg_jax.texture import MAX_SIDE
from a2tg_jax.training.options import Ranges, System
from a2tg_jax.training.stage import Stage

QUICK_TEXTURES: dict[str, Any] = {"rate": QUICK_TEXELS, "single_rate": 0.0}
"""Options of short runs (docs/results.md)."""
BUDGET_TEXELS = 5
"""Average number of texels per Gaussian under a memory budget: about the result of two or three upscalings of a quarter
of the Gaussians. Gaussians then take four fifths of the bytes."""
PAPER_THRESHOLD = 2e-5
"""k_G, in the unit of the authors' own statistic."""


@dataclasses.dataclass(frozen=True)
class TextureConfig(UpscaleChoices):
    """Adaptive anisotropic textures."""

    select: Literal["fraction", "threshold", "budget"] = Upscale.select
    """Rule that chooses the Gaussians to upscale; a memory_budget sets "budget"."""
    budget_mb: float | None = Upscale.budget_mb
    """Largest reported memory in MB (10^6 bytes); for select="budget" only, which needs it. It bounds the textures
    alone, beside the Gaussians of densify.cap; memory_budget chooses both."""
    gradient: Statistic = Upscale.gradient
    """Gradient that chooses: by position in the world, or "screen" as in the authors' program."""
    moments: Literal["zero", "copied"] = Upscale.moments
    """Adam's moments of a texture that has grown: zero, or copied from its old texels as in the authors' program."""
    upscale_at: tuple[float, ...] | None = Upscale.at
    """Fractions of stage 2 at which textures grow; None: as often as it takes to reach the cap, every 1/60 of the
    stage as in the paper, every 0.15 in stages under 30,000 iterations."""
    rate: float = 2.5e-3
    """Adam's learning rate of the texels."""
    single_rate: float | None = None
    """Adam's learning rate of textures of one texel, which only add a colour and opacity to their Gaussian; None:
    `rate`; 0: constant until they grow."""
    lookup: TextureOptions = dataclasses.field(default_factory=TextureOptions)
    """Options of the texture lookup."""

    def check(self) -> None:
        """Refuse the number of a rule that is not chosen; the threshold of the preset "official" may stay.

        Raises:
          ValueError: naming the options.
        """
        for select, name, usual in (("budget", "budget_mb", None), ("threshold", "threshold", PAPER_THRESHOLD)):
            number = getattr(self, name)
            if self.select != select and number not in (None, usual):
                raise ValueError(
                    f"texture.{name} is {number}, but texture.select is {self.select!r}: say texture.select {select}, "
                    f"or leave texture.{name} out"
                )

    def event(self) -> Upscale:
        """Return the upscaling of these options."""
        return from_options(Upscale, self, at=self.upscale_at)

    @staticmethod
    def official() -> "TextureConfig":
        """Return the choices of the authors' own program."""
        lookup = TextureOptions.official()
        return TextureConfig(
            select="threshold",
            threshold=PAPER_THRESHOLD,
            axes="authors",
            gradient="screen",
            moments="copied",
            lookup=lookup,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class A2tg(System):
    """Adaptive anisotropic textured Gaussians: MCMC densification, then textures that grow."""

    stage1_iterations: int = 30_000
    """Iterations of the first stage."""
    stage2_iterations: int = 30_000
    """Iterations of the second stage."""
    densify: McmcConfig = dataclasses.field(default_factory=McmcConfig)
    noise_in_stage2: bool = False
    """Whether exploration noise goes on in stage 2, as in the authors' program."""
    texture: TextureConfig = dataclasses.field(default_factory=TextureConfig)

    name: ClassVar[str] = "a2tg"
    ranges: ClassVar[Ranges] = {
        "texture.fraction": (0, 1),
        "texture.threshold": ANY_RATE,
        "texture.budget_mb": (1e-6, math.inf),
        "texture.k_a": (1, math.inf),
        "texture.k_s": ANY_RATE,
        "texture.cap": (1, MAX_SIDE),
        "texture.rate": ANY_RATE,
        "texture.single_rate": ANY_RATE,
        **LOOKUP_RANGES,
    }
    event_options: ClassVar[Mapping[str, str]] = {
        **MCMC_OPTIONS,
        **{f"Upscale.{field.name}": f"texture.{field.name}" for field in dataclasses.fields(Upscale)},
        "Upscale.at": "texture.upscale_at",
    }

    def stages(self) -> tuple[Stage, ...]:
        lookup, upscale = self.texture.lookup, self._texture().event()
        events = (*([Noise()] if self.noise_in_stage2 else []), upscale)
        cap = self.budget_cap(FLOATS_PER_TEXEL * self._budget_texels(upscale))
        first = growing_stage(self, self.stage1_iterations, self.densify.events(cap), Plain(lookup.max_alpha))
        textured = Textured((1, 1), lookup)
        single = self.texture.rate if self.texture.single_rate is None else self.texture.single_rate
        rates = TexelRates(self.texture.rate, single)
        return first, later_stage(self, "textures", textured, events, self.stage2_iterations, rates)

    def _texture(self) -> TextureConfig:
        """Return the textures' options, set by the memory budget if there is one."""
        if self.memory_budget is None:
            return self.texture
        if self.texture.budget_mb is not None:
            raise ValueError("memory_budget and texture.budget_mb both say how much memory there is: give one of them")
        return dataclasses.replace(self.texture, select="budget", budget_mb=megabytes_of(self.memory_budget))

    def _budget_texels(self, upscale: Upscale) -> float:
        """Return the texels per Gaussian that fit into the budget, at most half of the largest texture."""
        with self.naming_options():
            can_grow = bool(upscale.iterations(self.stage2_iterations))
        return min(BUDGET_TEXELS, (1 + upscale.cap**2) / 2) if can_grow else 1

    @classmethod
    def presets(cls) -> dict[str, Self]:
        return {
            "paper": cls(),
            "official": cls(noise_in_stage2=True, texture=TextureConfig.official()),
            "quick": cls(
                stage1_iterations=2_000,
                initial_opacity=QUICK_OPACITY,
                rates=QUICK_RATES,
                stage2_iterations=1_000,
                densify=McmcConfig(cap=QUICK_CAP),
                texture=TextureConfig(**QUICK_TEXTURES),
            ),
            "smoke": cls(
                **SMOKE,
                stage2_iterations=120,
                densify=McmcConfig(cap=SMOKE_CAP),
                texture=TextureConfig(fraction=0.5, upscale_at=(0.1, 0.2), **QUICK_TEXTURES),
            ),
        }  # fmt: skip

    def check(self) -> None:
        super().check()
        self.texture.check()

    def check_number(self, num: int) -> None:
        """Refuse a budget of textures that the Gaussians of the first stage already exhaust."""
        option = "initial_gaussians"
        if self.densify.is_enabled:
            option, num = "densify.cap", Mcmc(self.densify.cap).grown(num, self.stage1_iterations)
        self._check_budget(num, f"raise it, or lower {option}")

    def check_given_number(self, num: int) -> None:
        """Refuse a memory budget, or a budget of textures, that the given Gaussians already exhaust."""
        self.check_given_bytes(num)
        self._check_budget(num, "raise it")

    def _check_budget(self, num: int, remedy: str) -> None:
        if self._texture().select != "budget" or self.memory_budget is not None:
            return
        assert self.texture.budget_mb is not None
        needed = num * bytes_per_gaussian(self.sh_degree, FLOATS_PER_TEXEL) / MEGABYTE
        if self.texture.budget_mb < needed:
            raise ValueError(
                f"texture.budget_mb is {self.texture.budget_mb}, but {num:,} Gaussians of one texel each take "
                f"{needed:.3f} MB: {remedy}"
            )
