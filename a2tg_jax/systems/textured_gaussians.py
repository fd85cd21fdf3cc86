"""Textured Gaussians*: every texture k×k from the start of the second stage, no events."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar, Self

from a2tg_jax.appearance import Plain, Textured, TextureOptions
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
from a2tg_jax.training.options import Ranges, System
from a2tg_jax.training.stage import Stage


@dataclasses.dataclass(frozen=True)
class FixedTextureConfig:
    """Textures of one size."""

    side: int = 4
    """Side k of every texture of k×k texels, 1 to 16."""
    rate: float = 2.5e-3
    """Adam's learning rate of the texels."""
    lookup: TextureOptions = dataclasses.field(default_factory=TextureOptions)
    """Options of the texture lookup."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TexturedGaussians(System):
    """MCMC densification, then a second stage with textures of one size."""

    stage1_iterations: int = 30_000
    """Iterations of the first stage."""
    stage2_iterations: int = 30_000
    """Iterations of the second stage."""
    densify: McmcConfig = dataclasses.field(default_factory=McmcConfig)
    texture: FixedTextureConfig = dataclasses.field(default_factory=FixedTextureConfig)

    name: ClassVar[str] = "textured-gaussians"
    ranges: ClassVar[Ranges] = {
        "texture.side": (1, 16),
        "texture.rate": ANY_RATE,
        **LOOKUP_RANGES,
    }
    event_options: ClassVar[Mapping[str, str]] = MCMC_OPTIONS

    def stages(self) -> tuple[Stage, ...]:
        side = self.texture.side
        textured = Textured((side, side), self.texture.lookup)
        events = self.densify.events(self.budget_cap(FLOATS_PER_TEXEL * side * side))
        first = growing_stage(self, self.stage1_iterations, events, Plain(self.texture.lookup.max_alpha))
        return first, later_stage(self, "textures", textured, (), self.stage2_iterations, self.texture.rate)

    @classmethod
    def presets(cls) -> dict[str, Self]:
        return {
            "paper": cls(),
            "quick": cls(
                stage1_iterations=2_000,
                initial_opacity=QUICK_OPACITY,
                rates=QUICK_RATES,
                stage2_iterations=1_000,
                densify=McmcConfig(cap=QUICK_CAP),
                texture=FixedTextureConfig(rate=QUICK_TEXELS),
            ),
            "smoke": cls(**SMOKE, stage2_iterations=120, densify=McmcConfig(cap=SMOKE_CAP)),
        }  # fmt: skip
