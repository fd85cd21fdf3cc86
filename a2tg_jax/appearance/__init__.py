"""Appearances of splats: the renderer draws by an `AppearanceRule`, which an `Appearance` makes of its parameters.

`rule` and `base` are these two interfaces. `base` is made of two small ones: `rows`, which densification calls, and
`stored`, which files call. `plain`, `textured`, `movable_kernels` and `billboards` implement all of them. `banded` adds
view dependence to any appearance and `shaped` the shape of the kernel; `around` forwards the rest to it.
"""

from a2tg_jax.appearance.around import AppearanceAround as AppearanceAround
from a2tg_jax.appearance.banded import Banded as Banded
from a2tg_jax.appearance.banded import BandedRates as BandedRates
from a2tg_jax.appearance.base import Appearance as Appearance
from a2tg_jax.appearance.billboards import BillboardRule as BillboardRule
from a2tg_jax.appearance.billboards import Billboards as Billboards
from a2tg_jax.appearance.movable_kernels import MovableKernelParams as MovableKernelParams
from a2tg_jax.appearance.movable_kernels import MovableKernels as MovableKernels
from a2tg_jax.appearance.movable_kernels import MovableKernelsRule as MovableKernelsRule
from a2tg_jax.appearance.options import TextureOptions as TextureOptions
from a2tg_jax.appearance.plain import Plain as Plain
from a2tg_jax.appearance.portable import appearance_for as appearance_for
from a2tg_jax.appearance.rule import AppearanceRule as AppearanceRule
from a2tg_jax.appearance.rule import Features as Features
from a2tg_jax.appearance.rule import GivenColors as GivenColors
from a2tg_jax.appearance.rule import PlainRule as PlainRule
from a2tg_jax.appearance.rule import RuleAround as RuleAround
from a2tg_jax.appearance.rule import StaticRule as StaticRule
from a2tg_jax.appearance.rule import gaussian_cutoff as gaussian_cutoff
from a2tg_jax.appearance.rule_check import Arguments as Arguments
from a2tg_jax.appearance.rule_check import check_rule as check_rule
from a2tg_jax.appearance.rule_check import check_shading as check_shading
from a2tg_jax.appearance.rule_check import elementwise_rule as elementwise_rule
from a2tg_jax.appearance.rule_check import takes_arrays as takes_arrays
from a2tg_jax.appearance.shaped import Shaped as Shaped
from a2tg_jax.appearance.shaped import ShapedRates as ShapedRates
from a2tg_jax.appearance.textured import TexelRates as TexelRates
from a2tg_jax.appearance.textured import Textured as Textured
from a2tg_jax.appearance.textured import TexturedRule as TexturedRule
from a2tg_jax.appearance.textured import textured_rule as textured_rule
