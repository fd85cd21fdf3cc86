from .arrays import scene_from_arrays as scene_from_arrays
from .assembly import with_validation_views as with_validation_views
from .load import load_scene as load_scene
from .observations import ObservedPoints as ObservedPoints, observed_points as observed_points
from .photo_store import Mask as Mask, Picture as Picture
from .scene import (
    Scene as Scene,
    View as View,
    counted_pixels as counted_pixels,
    view_image as view_image,
    views_by_kind as views_by_kind,
)
from .sfm import SfmSummary as SfmSummary, run_sfm as run_sfm
from .synthetic import synthetic_scene as synthetic_scene
