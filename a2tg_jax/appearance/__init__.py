"""What splats show: `base` is the interface, `parts` are its optional parts: texture, exponents, bands.

`movable_kernels` and `billboards` are other appearances. Compositors trace `elementwise`; `files` names the arrays in
files.
"""

from a2tg_jax.appearance.base import Appearance as Appearance
from a2tg_jax.appearance.base import allocate_appearance as allocate_appearance
from a2tg_jax.appearance.base import appearance_for as appearance_for
from a2tg_jax.appearance.base import count_floats as count_floats
from a2tg_jax.appearance.base import gaussian_cutoff as gaussian_cutoff
from a2tg_jax.appearance.base import in_words as in_words
from a2tg_jax.appearance.base import projected as projected
from a2tg_jax.appearance.base import template_of as template_of
from a2tg_jax.appearance.billboards import Billboards as Billboards
from a2tg_jax.appearance.elementwise import Arguments as Arguments
from a2tg_jax.appearance.elementwise import Elementwise as Elementwise
from a2tg_jax.appearance.elementwise import StaticShading as StaticShading
from a2tg_jax.appearance.elementwise import check_is_appearance as check_is_appearance
from a2tg_jax.appearance.elementwise import check_shading as check_shading
from a2tg_jax.appearance.elementwise import elementwise_functions as elementwise_functions
from a2tg_jax.appearance.elementwise import takes_arrays as takes_arrays
from a2tg_jax.appearance.movable_kernels import MovableKernels as MovableKernels
from a2tg_jax.appearance.parts import Bands as Bands
from a2tg_jax.appearance.parts import Coefficients as Coefficients
from a2tg_jax.appearance.parts import Exponents as Exponents
from a2tg_jax.appearance.parts import Factor as Factor
from a2tg_jax.appearance.parts import Residual as Residual
from a2tg_jax.appearance.parts import TexelRates as TexelRates
from a2tg_jax.appearance.parts import Texture as Texture
from a2tg_jax.appearance.parts import TextureOptions as TextureOptions
