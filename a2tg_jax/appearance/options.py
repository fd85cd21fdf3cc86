"""How textures are read: the conventions in which programs for textured Gaussians differ."""

import dataclasses
from typing import Literal


@dataclasses.dataclass(frozen=True)
class TextureOptions:
    """Conventions of textures. The defaults follow the paper's text, `official()` the authors' program."""

    uv: Literal["texel-centre", "align-corners"] = "texel-centre"
    """Place of the texels: centres at half-texel offsets over ±3σ, or the outer ones exactly at ±3σ."""
    outside: Literal["clamp", "identity"] = "clamp"
    """Texture beyond ±3σ: the edge texel continues, or nothing shows (RGB 0, alpha 1)."""
    rgb: Literal["signed", "unit"] = "signed"
    """RGB residuals of either sign, or clipped to [0, 1]."""
    uv_gradient: bool = True
    """Whether gradients flow through the lookup position into the geometry."""
    initial_rgb: float = 0.0
    """Initial RGB."""
    alpha: Literal["projected", "global-maximum"] = "projected"
    """Alpha factors clamped to [0, 1] after each update; or any numbers, divided by the largest of all textures and
    clipped to [0, 1] when shown."""
    max_alpha: float = 0.99
    """Upper limit of a splat's alpha."""

    @staticmethod
    def official() -> "TextureOptions":
        """Return the conventions of the authors' program."""
        return TextureOptions("align-corners", "identity", "unit", False, 0.1, "global-maximum", max_alpha=0.999)
