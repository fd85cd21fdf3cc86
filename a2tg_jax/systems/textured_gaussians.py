"""Textured Gaussians*: every texture k×k from the start of the second stage, no events."""

import dataclasses
from typing import ClassVar, Self

from a2tg_jax.appearance import Appearance, Texture, TextureOptions
from a2tg_jax.core.checks import check_number
from a2tg_jax.mcmc import Mcmc
from a2tg_jax.systems.stage1 import (
    FLOATS_PER_TEXEL,
    QUICK,
    QUICK_CAP,
    QUICK_TEXELS,
    SMOKE,
    SMOKE_CAP,
    TwoStages,
    grown_by_mcmc,
)
from a2tg_jax.training.stage import Stage


@dataclasses.dataclass(frozen=True, kw_only=True)
class TexturedGaussians(TwoStages):
    """MCMC densification, then a second stage with textures of one size."""

    densify: Mcmc = Mcmc()
    """MCMC densification (3DGS-MCMC)."""
    texture_side: int = 4
    """Side k of every texture of k×k texels, 1 to 16."""
    texel_rate: float = 2.5e-3
    """Adam's learning rate of the texels."""
    lookup: TextureOptions = TextureOptions()
    """Options of the texture lookup."""

    name: ClassVar[str] = "textured-gaussians"

    def stages(self) -> tuple[Stage, ...]:
        side = self.texture_side
        growth = grown_by_mcmc(self.densify, self.budget_cap(FLOATS_PER_TEXEL * side * side))
        first = self.growing_stage(growth, Appearance(max_alpha=self.lookup.max_alpha))
        textured = Appearance(texture=Texture(None, (side, side), self.lookup))
        return first, self.later_stage("textures", textured, (), self.texel_rate)

    @classmethod
    def presets(cls) -> dict[str, Self]:
        return {
            "paper": cls(),
            "quick": cls(**QUICK, densify=Mcmc(cap=QUICK_CAP), texel_rate=QUICK_TEXELS),
            "smoke": cls(**SMOKE, stage2_iterations=120, densify=Mcmc(cap=SMOKE_CAP)),
        }

    def check_options(self) -> None:
        super().check_options()
        check_number("texture_side", self.texture_side, least=1, most=16)
        check_number("texel_rate", self.texel_rate, least=0)
