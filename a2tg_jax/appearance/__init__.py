"""Appearance of splats: `base` is the interface, `parts` are its optional parts: texture, exponents, bands.

`shapes` are always shapes of kernels, numbers from which their exponents follow; arrays have sizes.

`movable_kernels` and `billboards` are other appearances. Compositors trace `elementwise`; `files` names the arrays in
files.
"""

from a2tg_jax.appearance.base import (
    Appearance as Appearance,
    allocate_appearance as allocate_appearance,
    count_floats as count_floats,
    gaussian_cutoff as gaussian_cutoff,
    project_appearance as project_appearance,
)
from a2tg_jax.appearance.billboards import Billboards as Billboards
from a2tg_jax.appearance.elementwise import (
    Arguments as Arguments,
    Elementwise as Elementwise,
    StaticShading as StaticShading,
    check_is_appearance as check_is_appearance,
    check_shading as check_shading,
    elementwise_functions as elementwise_functions,
    takes_arrays as takes_arrays,
)
from a2tg_jax.appearance.movable_kernels import MovableKernels as MovableKernels
from a2tg_jax.appearance.parts import (
    Bands as Bands,
    Coefficients as Coefficients,
    Exponents as Exponents,
    Factor as Factor,
    Residual as Residual,
    TexelRates as TexelRates,
    Texture as Texture,
    TextureOptions as TextureOptions,
)
