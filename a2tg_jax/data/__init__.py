"""Everything that turns input into a Scene: COLMAP, transforms.json, plain photographs, the built-in scene."""

from a2tg_jax.core.similarity import Similarity as Similarity
from a2tg_jax.data.load import load_scene as load_scene
from a2tg_jax.data.masks import Mask as Mask
from a2tg_jax.data.photo_store import Picture as Picture
from a2tg_jax.data.scene import Scene as Scene
from a2tg_jax.data.scene import View as View
from a2tg_jax.data.scene import counted_pixels as counted_pixels
from a2tg_jax.data.scene import view_image as view_image
from a2tg_jax.data.scene import views_by_size as views_by_size
from a2tg_jax.data.sfm import SfmSummary as SfmSummary
from a2tg_jax.data.sfm import run_sfm as run_sfm
from a2tg_jax.data.synthetic import synthetic_scene as synthetic_scene
