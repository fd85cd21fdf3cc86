"""A²TG: plain Gaussians first, then textures that grow where the gradient is large (arXiv 2026, §3)."""

import dataclasses
import math
from typing import Any, ClassVar, Self

from a2tg_jax.adapt import Upscale
from a2tg_jax.appearance import Appearance, TexelRates, Texture, TextureOptions
from a2tg_jax.base.checks import check_fields, check_number
from a2tg_jax.base.text import MEGABYTE, megabytes_of
from a2tg_jax.core.budget import bytes_per_gaussian
from a2tg_jax.core.gaussians import floats_per_gaussian
from a2tg_jax.mcmc import Mcmc, Noise
from a2tg_jax.systems.two_stages import (
    FLOATS_PER_TEXEL,
    QUICK_CAP,
    QUICK_TEXELS,
    SMOKE_CAP,
    LimitExponents,
    TwoStages,
    grown_by_mcmc,
    kernels_of,
)
from a2tg_jax.training.stage import Stage

QUICK_OPTIONS: dict[str, Any] = {
    "stage1_iterations": 1_500, "stage2_iterations": 1_500, "texel_rate": QUICK_TEXELS, "empty_textures": True,
    "texture_share": 0.25, "kernel_rate": 0.01, "lookup": TextureOptions(extent=1.5), "densify": Mcmc(cap=QUICK_CAP),
}  # fmt: skip
"""Options of the preset "quick", chosen in experiments/NOTEBOOK.md, "Four handicaps of textures in short runs"."""
SMOKE_OPTIONS: dict[str, Any] = {
    "stage2_iterations": 120, "texel_rate": QUICK_TEXELS, "single_texel_rate": 0.0, "densify": Mcmc(cap=SMOKE_CAP),
    "texture": Upscale(fraction=0.5, at=(0.1, 0.2)),
}  # fmt: skip
BUDGET_TEXELS = 5
"""Average number of texels per Gaussian under a memory budget: about the result of two or three upscalings of a quarter
of the Gaussians. Gaussians then take four fifths of the bytes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class A2tg(TwoStages):
    """Adaptive anisotropic textured Gaussians: MCMC densification, then textures that grow.

    A²TG, *Adaptive Anisotropic Textured Gaussians for Efficient 3D Scene Representation*; `Upscale` has its rule.

    Examples:
      >>> system = a2tg.A2tg.preset("quick", memory_budget="300kB", texture={"cap": 8})
      >>> [stage.name for stage in system.stages()]
      ['gaussians', 'textures']
    """

    densify: Mcmc = Mcmc()
    """MCMC densification (3DGS-MCMC)."""
    noise_in_stage2: bool = False
    """Whether exploration noise continues in stage 2, as in the authors' program."""
    texture: Upscale = Upscale()
    """Adaptive anisotropic textures."""
    texel_rate: float = 2.5e-3
    """Adam's learning rate of the texels."""
    single_texel_rate: float | None = None
    """Adam's learning rate of textures of one texel, which only add a colour and opacity to their Gaussian; None:
    texel_rate; 0: constant until they grow."""
    empty_textures: bool = False
    """Whether Gaussians have no texture, which takes no bytes, until they are chosen to get more texels; off: all begin
    with one texel."""
    texture_share: float | None = None
    """Share of a memory_budget for textures, at most what the largest ones take, which decides the number of Gaussians;
    None: room for 5 texels per Gaussian, or for half of the largest texture if that is less."""
    kernel_rate: float | None = None
    """Adam's learning rate of the kernels' shapes; None or 0: all kernels are Gaussians, as in the paper."""
    exponents: LimitExponents = LimitExponents()
    """Lower limit of the exponents of kernels; 0: no limit."""
    lookup: TextureOptions = TextureOptions()
    """Options of the texture lookup."""

    name: ClassVar[str] = "a2tg"

    def stages(self) -> tuple[Stage, ...]:
        texture = self.texture
        if self.memory_budget is not None:
            if texture.budget_mb is not None:
                raise ValueError("memory_budget and texture.budget_mb both set the memory: give one of them")
            budget = megabytes_of(self.memory_budget)
            # Thresholds belong to another rule, and custom ones would be rejected.
            texture = dataclasses.replace(texture, select="budget", threshold=None, budget_mb=budget)
        kernels = kernels_of(self.kernel_rate, self.exponents)
        growth = grown_by_mcmc(self.densify, self.budget_cap(self._floats_in_budget()))
        plain = Appearance(exponents=kernels.part, max_alpha=self.lookup.max_alpha)
        first = self.growing_stage((*growth, *kernels.limits), plain, kernels.rates or None)
        events = (*([Noise()] if self.noise_in_stage2 else []), texture, *kernels.limits)
        single = self.texel_rate if self.single_texel_rate is None else self.single_texel_rate
        rates = kernels.rates | {"texture": TexelRates(self.texel_rate, single)}
        textured = Appearance(texture=Texture(None, self._start, self.lookup), exponents=kernels.part)
        return first, self.later_stage("textures", textured, events, rates)

    @property
    def _start(self) -> tuple[int, int]:
        """Size of every texture when the second stage begins."""
        return (0, 0) if self.empty_textures else (1, 1)

    def _floats(self, texels: float) -> float:
        """Return the floats of a Gaussian's kernel and of its texels."""
        return bool(self.kernel_rate) + FLOATS_PER_TEXEL * texels

    def _floats_in_budget(self) -> float:
        """Return the floats of kernel and texels that a Gaussian has on average in a full memory budget."""
        least = math.prod(self._start)
        most = self.texture.cap**2 if self.texture.times(self.stage2_iterations) else least
        if self.texture_share is None:
            # Up to half of the largest texture.
            return self._floats(min(BUDGET_TEXELS, (least + most) / 2))
        floats = floats_per_gaussian(self.sh_degree) + self._floats(0)
        texels = floats * self.texture_share / (1 - self.texture_share) / FLOATS_PER_TEXEL
        return self._floats(min(max(texels, least), most))

    @classmethod
    def presets(cls) -> dict[str, Self]:
        official = cls(noise_in_stage2=True, texture=Upscale.official(), lookup=TextureOptions.official())
        paper, *short = cls.short_presets(QUICK_OPTIONS, SMOKE_OPTIONS).items()
        return dict([paper, ("official", official), *short])

    def check_options(self) -> None:
        super().check_options()
        check_fields(self, "texel_rate", "single_texel_rate", "kernel_rate", least=0)
        check_fields(self, "texture_share", least=0, below=1)
        if self.empty_textures:
            check_number("texture.cap", self.texture.cap, least=2)
            # A rate of 0, as in short presets, holds nothing still.
            for name, value in (
                ("single_texel_rate", self.single_texel_rate),
                ("lookup.initial_rgb", self.lookup.initial_rgb),
            ):
                if value:
                    raise ValueError(
                        f"{name} has no effect with empty_textures, which grow to more than one texel at once, of RGB "
                        f"0: leave it out; got {value}"
                    )

    def check_initial_number(self, num: int) -> None:
        """Check that the texture budget has room for the Gaussians of the first stage."""
        option = "initial_gaussians"
        if self.densify.cap:
            option = "densify.cap"
            num = self.densify.grown(num, self.stage1_iterations)
        self._check_budget(num, f"raise it, or lower {option}")

    def check_given_number(self, num: int) -> None:
        """Check that the memory budget or the texture budget has room for the given Gaussians."""
        # At most one of them is set, as `stages` checks; given Gaussians do not grow as `check_initial_number` expects.
        if self.texture.budget_mb is None:
            super().check_given_number(num)
        self._check_budget(num, "raise it")

    def _check_budget(self, num: int, remedy: str) -> None:
        if self.texture.budget_mb is None:
            return
        needed = num * bytes_per_gaussian(self.sh_degree, self._floats(math.prod(self._start))) / MEGABYTE
        if self.texture.budget_mb < needed:
            textures = "without textures" if self.empty_textures else "of one texel each"
            raise ValueError(
                f"texture.budget_mb is {self.texture.budget_mb}, but {num:,} Gaussians {textures} take {needed:.3f} "
                f"MB: {remedy}"
            )
