"""Adaptive anisotropic textured Gaussians as a functional JAX library: the public names.

Names are imported at their first use, so that `import a2tg_jax` costs little more than `import jax`.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from a2tg_jax.adapt import Upscale as Upscale
    from a2tg_jax.adapt import next_sizes as next_sizes
    from a2tg_jax.adapt import reallocate as reallocate
    from a2tg_jax.adapt import select as select
    from a2tg_jax.appearance import Appearance as Appearance
    from a2tg_jax.appearance import Bands as Bands
    from a2tg_jax.appearance import Exponents as Exponents
    from a2tg_jax.appearance import TexelRates as TexelRates
    from a2tg_jax.appearance import Texture as Texture
    from a2tg_jax.appearance import TextureOptions as TextureOptions
    from a2tg_jax.appearance import allocate_appearance as allocate_appearance
    from a2tg_jax.core.bilinear import TextureRegion as TextureRegion
    from a2tg_jax.core.cameras import Camera as Camera
    from a2tg_jax.core.cameras import resize_camera as resize_camera
    from a2tg_jax.core.gaussians import Gaussians as Gaussians
    from a2tg_jax.core.gaussians import init_from_points as init_from_points
    from a2tg_jax.core.gradient_statistics import GradientStatistics as GradientStatistics
    from a2tg_jax.core.optim import adam_init as adam_init
    from a2tg_jax.core.optim import adam_update as adam_update
    from a2tg_jax.core.optim import exponential_decay as exponential_decay
    from a2tg_jax.core.origin import Origin as Origin
    from a2tg_jax.core.paths import look_at as look_at
    from a2tg_jax.core.paths import path_through as path_through
    from a2tg_jax.core.paths import smooth_path as smooth_path
    from a2tg_jax.core.pytree import combine as combine
    from a2tg_jax.core.pytree import partition as partition
    from a2tg_jax.core.pytree import pytree as pytree
    from a2tg_jax.core.pytree import static as static
    from a2tg_jax.core.similarity import Similarity as Similarity
    from a2tg_jax.core.similarity import transform_gaussians as transform_gaussians
    from a2tg_jax.data import Mask as Mask
    from a2tg_jax.data import ObservedPoints as ObservedPoints
    from a2tg_jax.data import Picture as Picture
    from a2tg_jax.data import Scene as Scene
    from a2tg_jax.data import View as View
    from a2tg_jax.data import load_scene as load_scene
    from a2tg_jax.data import observed_points as observed_points
    from a2tg_jax.data import run_sfm as run_sfm
    from a2tg_jax.data import scene_from_arrays as scene_from_arrays
    from a2tg_jax.data import synthetic_scene as synthetic_scene
    from a2tg_jax.data import view_image as view_image
    from a2tg_jax.data import with_validation_views as with_validation_views
    from a2tg_jax.densify.clone_split import CloneSplitPrune as CloneSplitPrune
    from a2tg_jax.densify.clone_split import FillingDensity as FillingDensity
    from a2tg_jax.densify.clone_split import OpacityReset as OpacityReset
    from a2tg_jax.densify.pruning import Prune as Prune
    from a2tg_jax.densify.pruning import PruneFloaters as PruneFloaters
    from a2tg_jax.densify.splitting import SplitByGradient as SplitByGradient
    from a2tg_jax.densify.view_dependence import AdaptDegrees as AdaptDegrees
    from a2tg_jax.events import Change as Change
    from a2tg_jax.events import Due as Due
    from a2tg_jax.events import EventInfo as EventInfo
    from a2tg_jax.events import HostEvent as HostEvent
    from a2tg_jax.events import StepEvent as StepEvent
    from a2tg_jax.events import Times as Times
    from a2tg_jax.events import keep_rows as keep_rows
    from a2tg_jax.finish.compaction import loss_beside_renders as loss_beside_renders
    from a2tg_jax.finish.compaction import loss_on_views as loss_on_views
    from a2tg_jax.finish.compaction import measure_choices as measure_choices
    from a2tg_jax.finish.compaction import smallest_within as smallest_within
    from a2tg_jax.finish.polishing import polish as polish
    from a2tg_jax.finish.shrinking import shrink_textures as shrink_textures
    from a2tg_jax.finish.tuning import Tuned as Tuned
    from a2tg_jax.finish.tuning import tune_compact as tune_compact
    from a2tg_jax.host.cores import set_num_threads as set_num_threads
    from a2tg_jax.host.startup import configure_cpu as configure_cpu
    from a2tg_jax.io.compact import CompactChoices as CompactChoices
    from a2tg_jax.io.compact import load_compact as load_compact
    from a2tg_jax.io.compact import save_compact as save_compact
    from a2tg_jax.io.formats import load_splats as load_splats
    from a2tg_jax.io.formats import save_splats as save_splats
    from a2tg_jax.io.gltf import load_gltf as load_gltf
    from a2tg_jax.io.gltf import save_gltf as save_gltf
    from a2tg_jax.io.model_file import load_model as load_model
    from a2tg_jax.io.model_file import save_model as save_model
    from a2tg_jax.io.ply import load_ply as load_ply
    from a2tg_jax.io.ply import save_ply as save_ply
    from a2tg_jax.io.usd import load_usd as load_usd
    from a2tg_jax.io.usd import save_usd as save_usd
    from a2tg_jax.mcmc import FillingMcmc as FillingMcmc
    from a2tg_jax.mcmc import Mcmc as Mcmc
    from a2tg_jax.mcmc import Noise as Noise
    from a2tg_jax.mcmc import grow as grow
    from a2tg_jax.mcmc import perturb as perturb
    from a2tg_jax.mcmc import relocate as relocate
    from a2tg_jax.measure.alignment import align_poses as align_poses
    from a2tg_jax.measure.alignment import color_fit as color_fit
    from a2tg_jax.measure.evaluation import evaluate as evaluate
    from a2tg_jax.measure.metrics import load_lpips as load_lpips
    from a2tg_jax.measure.metrics import lpips as lpips
    from a2tg_jax.measure.metrics import parameter_bytes as parameter_bytes
    from a2tg_jax.measure.metrics import psnr as psnr
    from a2tg_jax.measure.metrics import ssim as ssim
    from a2tg_jax.mesh.distance import SurfaceDistance as SurfaceDistance
    from a2tg_jax.mesh.distance import sample_surface as sample_surface
    from a2tg_jax.mesh.distance import surface_distance as surface_distance
    from a2tg_jax.mesh.extract import MeshResult as MeshResult
    from a2tg_jax.mesh.extract import extract_mesh as extract_mesh
    from a2tg_jax.mesh.files import save_mesh as save_mesh
    from a2tg_jax.mesh.simplify import simplify_mesh as simplify_mesh
    from a2tg_jax.mesh.texturing import texture_mesh as texture_mesh
    from a2tg_jax.mesh.triangles import Mesh as Mesh
    from a2tg_jax.model import Model as Model
    from a2tg_jax.model import concatenate as concatenate
    from a2tg_jax.rasterize.render_types import RenderOutput as RenderOutput
    from a2tg_jax.rasterize.render_types import RenderSettings as RenderSettings
    from a2tg_jax.render import CapacityWarning as CapacityWarning
    from a2tg_jax.render import render_appearance as render_appearance
    from a2tg_jax.render import render_image as render_image
    from a2tg_jax.renderer import Renderer as Renderer
    from a2tg_jax.renderer import plan_render as plan_render
    from a2tg_jax.systems.a2tg import A2tg as A2tg
    from a2tg_jax.systems.baselines import BBSplat as BBSplat
    from a2tg_jax.systems.baselines import Gaussians2d as Gaussians2d
    from a2tg_jax.systems.baselines import Gaussians2dMcmc as Gaussians2dMcmc
    from a2tg_jax.systems.baselines import SuperGaussians as SuperGaussians
    from a2tg_jax.systems.baselines import TexturedGaussians as TexturedGaussians
    from a2tg_jax.systems.bytewise import Bytewise as Bytewise
    from a2tg_jax.systems.bytewise import LimitExponents as LimitExponents
    from a2tg_jax.texture import Textures as Textures
    from a2tg_jax.texture import allocate_textures as allocate_textures
    from a2tg_jax.texture import texture_arrays as texture_arrays
    from a2tg_jax.texture import textures_from_arrays as textures_from_arrays
    from a2tg_jax.training import Checkpoint as Checkpoint
    from a2tg_jax.training import DivergedError as DivergedError
    from a2tg_jax.training import FitResult as FitResult
    from a2tg_jax.training import History as History
    from a2tg_jax.training import Interrupted as Interrupted
    from a2tg_jax.training import LearningRates as LearningRates
    from a2tg_jax.training import LossConfig as LossConfig
    from a2tg_jax.training import Session as Session
    from a2tg_jax.training import Stage as Stage
    from a2tg_jax.training import StageResult as StageResult
    from a2tg_jax.training import System as System
    from a2tg_jax.training import Target as Target
    from a2tg_jax.training import Term as Term
    from a2tg_jax.training import find_system as find_system
    from a2tg_jax.training import fit as fit
    from a2tg_jax.training import fit_stage as fit_stage
    from a2tg_jax.training import like as like
    from a2tg_jax.training import load_checkpoint as load_checkpoint
    from a2tg_jax.training import save_checkpoint as save_checkpoint
    from a2tg_jax.training.corrections import BilateralGrid as BilateralGrid
    from a2tg_jax.training.corrections import Correction as Correction
    from a2tg_jax.training.corrections import Exposure as Exposure
    from a2tg_jax.training.corrections import PoseRefinement as PoseRefinement
    from a2tg_jax.training.gradients import ViewGradients as ViewGradients
    from a2tg_jax.training.gradients import value_and_grad as value_and_grad
    from a2tg_jax.training.gradients import view_gradients as view_gradients
    from a2tg_jax.training.losses import normal_consistency as normal_consistency
    from a2tg_jax.training.losses import photometric_loss as photometric_loss

_NAMES = {
    "a2tg_jax.adapt": ("Upscale", "next_sizes", "reallocate", "select"),
    "a2tg_jax.appearance": (
        "Appearance",
        "Bands",
        "Exponents",
        "TexelRates",
        "Texture",
        "TextureOptions",
        "allocate_appearance",
    ),
    "a2tg_jax.core.bilinear": ("TextureRegion",),
    "a2tg_jax.core.cameras": ("Camera", "resize_camera"),
    "a2tg_jax.core.gaussians": ("Gaussians", "init_from_points"),
    "a2tg_jax.core.gradient_statistics": ("GradientStatistics",),
    "a2tg_jax.core.optim": ("adam_init", "adam_update", "exponential_decay"),
    "a2tg_jax.core.origin": ("Origin",),
    "a2tg_jax.core.paths": ("look_at", "path_through", "smooth_path"),
    "a2tg_jax.core.pytree": ("combine", "partition", "pytree", "static"),
    "a2tg_jax.core.similarity": ("Similarity", "transform_gaussians"),
    "a2tg_jax.data": (
        "Mask",
        "ObservedPoints",
        "Picture",
        "Scene",
        "View",
        "load_scene",
        "observed_points",
        "run_sfm",
        "scene_from_arrays",
        "synthetic_scene",
        "view_image",
        "with_validation_views",
    ),
    "a2tg_jax.densify.clone_split": ("CloneSplitPrune", "FillingDensity", "OpacityReset"),
    "a2tg_jax.densify.pruning": ("Prune", "PruneFloaters"),
    "a2tg_jax.densify.splitting": ("SplitByGradient",),
    "a2tg_jax.densify.view_dependence": ("AdaptDegrees",),
    "a2tg_jax.events": ("Change", "Due", "EventInfo", "HostEvent", "StepEvent", "Times", "keep_rows"),
    "a2tg_jax.finish.compaction": ("loss_beside_renders", "loss_on_views", "measure_choices", "smallest_within"),
    "a2tg_jax.finish.polishing": ("polish",),
    "a2tg_jax.finish.shrinking": ("shrink_textures",),
    "a2tg_jax.finish.tuning": ("Tuned", "tune_compact"),
    "a2tg_jax.host.cores": ("set_num_threads",),
    "a2tg_jax.host.startup": ("configure_cpu",),
    "a2tg_jax.io.compact": ("CompactChoices", "load_compact", "save_compact"),
    "a2tg_jax.io.formats": ("load_splats", "save_splats"),
    "a2tg_jax.io.gltf": ("load_gltf", "save_gltf"),
    "a2tg_jax.io.model_file": ("load_model", "save_model"),
    "a2tg_jax.io.ply": ("load_ply", "save_ply"),
    "a2tg_jax.io.usd": ("load_usd", "save_usd"),
    "a2tg_jax.mcmc": ("FillingMcmc", "Mcmc", "Noise", "grow", "perturb", "relocate"),
    "a2tg_jax.measure.alignment": ("align_poses", "color_fit"),
    "a2tg_jax.measure.evaluation": ("evaluate",),
    "a2tg_jax.measure.metrics": ("load_lpips", "lpips", "parameter_bytes", "psnr", "ssim"),
    "a2tg_jax.mesh.distance": ("SurfaceDistance", "sample_surface", "surface_distance"),
    "a2tg_jax.mesh.extract": ("MeshResult", "extract_mesh"),
    "a2tg_jax.mesh.files": ("save_mesh",),
    "a2tg_jax.mesh.simplify": ("simplify_mesh",),
    "a2tg_jax.mesh.texturing": ("texture_mesh",),
    "a2tg_jax.mesh.triangles": ("Mesh",),
    "a2tg_jax.model": ("Model", "concatenate"),
    "a2tg_jax.rasterize.render_types": ("RenderOutput", "RenderSettings"),
    "a2tg_jax.render": ("CapacityWarning", "render_appearance", "render_image"),
    "a2tg_jax.renderer": ("Renderer", "plan_render"),
    "a2tg_jax.systems.a2tg": ("A2tg",),
    "a2tg_jax.systems.baselines": ("BBSplat", "Gaussians2d", "Gaussians2dMcmc", "SuperGaussians", "TexturedGaussians"),
    "a2tg_jax.systems.bytewise": ("Bytewise", "LimitExponents"),
    "a2tg_jax.texture": ("Textures", "allocate_textures", "texture_arrays", "textures_from_arrays"),
    "a2tg_jax.training": (
        "Checkpoint",
        "DivergedError",
        "FitResult",
        "History",
        "Interrupted",
        "LearningRates",
        "LossConfig",
        "Session",
        "Stage",
        "StageResult",
        "System",
        "Target",
        "Term",
        "find_system",
        "fit",
        "fit_stage",
        "like",
        "load_checkpoint",
        "save_checkpoint",
    ),
    "a2tg_jax.training.corrections": ("BilateralGrid", "Correction", "Exposure", "PoseRefinement"),
    "a2tg_jax.training.gradients": ("ViewGradients", "value_and_grad", "view_gradients"),
    "a2tg_jax.training.losses": ("normal_consistency", "photometric_loss"),
}
"""Public names by the module that defines them: the imports above, once more."""

_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}
_ROOMS = {module.split(".")[1] for module in _NAMES}
__all__ = sorted(_MODULE_OF)
__version__: str

if not TYPE_CHECKING:  # Type checkers see the imports above, and that no other name exists.

    def __getattr__(name: str) -> Any:
        """Import a public name, or the room of some, at its first use."""
        if name == "__version__":
            return importlib.import_module("importlib.metadata").version("a2tg-jax")
        if name in _ROOMS:
            return importlib.import_module(f"{__name__}.{name}")
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value = getattr(importlib.import_module(_MODULE_OF[name]), name)
        importlib.import_module(f"{__name__}.host.field_docs").tell_fields()
        return value

    def __dir__() -> list[str]:
        return sorted({*__all__, "__version__", *(name for name in globals() if name.startswith("__"))})
