"""Appearance of Gaussians with or without textures, shapes and degrees, from the contents of a file."""

from a2tg_jax.appearance.banded import Banded
from a2tg_jax.appearance.base import Appearance
from a2tg_jax.appearance.options import TextureOptions
from a2tg_jax.appearance.plain import Plain
from a2tg_jax.appearance.shaped import Shaped
from a2tg_jax.appearance.textured import Textured


def appearance_for(
    options: TextureOptions, *, has_textures: bool, has_degrees: bool = False, has_shapes: bool = False
) -> Appearance:
    """Return the portable appearance of these options; without textures, only `options.max_alpha` counts."""
    base: Appearance = Textured(options=options) if has_textures else Plain(options.max_alpha)
    base = Shaped(base) if has_shapes else base
    return Banded(base) if has_degrees else base
