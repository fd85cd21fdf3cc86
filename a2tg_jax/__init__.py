"""Adaptive anisotropic textured Gaussians as a functional JAX library: the public names."""

from a2tg_jax.cameras import Camera as Camera
from a2tg_jax.gaussians import Gaussians as Gaussians
from a2tg_jax.gaussians import init_from_points as init_from_points
from a2tg_jax.lookup import TextureOptions as TextureOptions
from a2tg_jax.render import RenderOutput as RenderOutput
from a2tg_jax.render import RenderSettings as RenderSettings
from a2tg_jax.render import plan_render as plan_render
from a2tg_jax.render import render_image as render_image
from a2tg_jax.texture import AtlasLayout as AtlasLayout
from a2tg_jax.texture import Textures as Textures
from a2tg_jax.texture import allocate_textures as allocate_textures
from a2tg_jax.texture import texture_arrays as texture_arrays
from a2tg_jax.texture import textures_from_arrays as textures_from_arrays
