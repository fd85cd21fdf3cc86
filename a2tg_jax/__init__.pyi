"""Public names, for type checkers and for `__init__.py`, which imports each at its first use."""

from .adapt import (
    ReallocateResult as ReallocateResult,
    Upscale as Upscale,
    next_sizes as next_sizes,
    reallocate as reallocate,
    select as select,
)
from .appearance import (
    Appearance as Appearance,
    Bands as Bands,
    Exponents as Exponents,
    TexelRates as TexelRates,
    Texture as Texture,
    TextureOptions as TextureOptions,
    allocate_appearance as allocate_appearance,
    project_appearance as project_appearance,
)
from .base.checks import check_number as check_number
from .base.threads import set_num_threads as set_num_threads
from .core.bilinear import TextureRegion as TextureRegion
from .core.cameras import Camera as Camera, back_project as back_project, resize_camera as resize_camera
from .core.gaussians import Gaussians as Gaussians, init_from_points as init_from_points
from .core.optim import (
    AdamState as AdamState,
    adam_init as adam_init,
    adam_update as adam_update,
    exponential_decay as exponential_decay,
)
from .core.origin import Origin as Origin
from .core.pictures import DepthMap as DepthMap, Mask as Mask, Picture as Picture
from .core.pytree import (
    combine as combine,
    partition as partition,
    pytree as pytree,
    shared as shared,
    static as static,
)
from .core.similarity import Similarity as Similarity, transform_gaussians as transform_gaussians
from .data.arrays import scene_from_arrays as scene_from_arrays
from .data.assembly import with_validation_views as with_validation_views
from .data.camera_paths import (
    look_at as look_at,
    path_through as path_through,
    smooth_path as smooth_path,
    turntable as turntable,
)
from .data.load import load_scene as load_scene
from .data.sfm import SfmSummary as SfmSummary, run_sfm as run_sfm
from .data.synthetic import cells_scene as cells_scene, synthetic_scene as synthetic_scene
from .densify.clone_split import (
    CloneSplitPrune as CloneSplitPrune,
    FillingDensity as FillingDensity,
    OpacityReset as OpacityReset,
)
from .densify.placing import PlaceByError as PlaceByError
from .densify.pruning import Prune as Prune, PruneFloaters as PruneFloaters
from .densify.splitting import SplitByGradient as SplitByGradient
from .densify.view_dependence import AdaptDegrees as AdaptDegrees
from .events import (
    Change as Change,
    Due as Due,
    EventInfo as EventInfo,
    GradientStatistics as GradientStatistics,
    HostEvent as HostEvent,
    Now as Now,
    Seen as Seen,
    StepEvent as StepEvent,
    keep_rows as keep_rows,
)
from .finish.compaction import (
    Trial as Trial,
    loss_beside_renders as loss_beside_renders,
    loss_on_views as loss_on_views,
    measure_choices as measure_choices,
    smallest_within as smallest_within,
)
from .finish.polishing import polish as polish
from .finish.shrinking import shrink_textures as shrink_textures
from .finish.tuning import Tuned as Tuned, tune_compact as tune_compact
from .host.signals import stop_on_signals as stop_on_signals
from .host.startup import configure_cpu as configure_cpu
from .host.training_bar import ProgressBar as ProgressBar
from .io.compact import CompactChoices as CompactChoices, load_compact as load_compact, save_compact as save_compact
from .io.edit_file import Box as Box, Edit as Edit, apply_edit as apply_edit, load_edit as load_edit
from .io.formats import load_splats as load_splats, save_splats as save_splats
from .io.gltf import load_gltf as load_gltf, save_gltf as save_gltf
from .io.ply import load_ply as load_ply, save_ply as save_ply
from .io.torch_checkpoint import to_gsplat as to_gsplat
from .io.usd import load_usd as load_usd, save_usd as save_usd
from .mcmc import (
    FillingMcmc as FillingMcmc,
    Mcmc as Mcmc,
    MoveInfo as MoveInfo,
    MoveResult as MoveResult,
    Noise as Noise,
    grow as grow,
    perturb as perturb,
    relocate as relocate,
)
from .measure.alignment import align_poses as align_poses, color_fit as color_fit
from .measure.evaluation import Evaluation as Evaluation, ViewMetrics as ViewMetrics, evaluate as evaluate
from .measure.metrics import (
    LpipsWeights as LpipsWeights,
    load_lpips as load_lpips,
    lpips as lpips,
    parameter_bytes as parameter_bytes,
    psnr as psnr,
    ssim as ssim,
)
from .mesh.extract import MeshResult as MeshResult, extract_mesh as extract_mesh
from .mesh.files import save_mesh as save_mesh
from .mesh.texturing import texture_mesh as texture_mesh
from .mesh.triangles import (
    Mesh as Mesh,
    SurfaceDistance as SurfaceDistance,
    sample_surface as sample_surface,
    simplify_mesh as simplify_mesh,
    surface_distance as surface_distance,
)
from .model import Model as Model, concatenate as concatenate
from .model_file import load_model as load_model, save_model as save_model
from .rasterize.render_types import Geometry as Geometry, RenderOutput as RenderOutput, RenderSettings as RenderSettings
from .rasterize.room import EmptyRenderWarning as EmptyRenderWarning
from .render import (
    CapacityWarning as CapacityWarning,
    render_appearance as render_appearance,
    render_image as render_image,
)
from .renderer import Renderer as Renderer, plan_render as plan_render
from .scene import Scene as Scene, View as View, view_image as view_image
from .systems.a2tg import A2tg as A2tg
from .systems.baselines import (
    BBSplat as BBSplat,
    BillboardOptions as BillboardOptions,
    Gaussians2d as Gaussians2d,
    Gaussians2dMcmc as Gaussians2dMcmc,
    SuperGaussians as SuperGaussians,
    TexturedGaussians as TexturedGaussians,
)
from .systems.bytewise import Bytewise as Bytewise
from .systems.two_stages import LimitExponents as LimitExponents
from .texture import (
    Textures as Textures,
    allocate_textures as allocate_textures,
    texture_arrays as texture_arrays,
    textures_from_arrays as textures_from_arrays,
)
from .training import (
    Checkpoint as Checkpoint,
    DivergedError as DivergedError,
    FitResult as FitResult,
    History as History,
    Interrupted as Interrupted,
    LearningRates as LearningRates,
    LossConfig as LossConfig,
    Session as Session,
    Stage as Stage,
    StageResult as StageResult,
    System as System,
    Target as Target,
    Term as Term,
    find_system as find_system,
    fit as fit,
    fit_stage as fit_stage,
    like as like,
    load_checkpoint as load_checkpoint,
    save_checkpoint as save_checkpoint,
)
from .training.corrections import (
    BilateralGrid as BilateralGrid,
    Correction as Correction,
    Exposure as Exposure,
    PoseRefinement as PoseRefinement,
)
from .training.gradients import (
    ViewGradients as ViewGradients,
    value_and_grad as value_and_grad,
    view_gradients as view_gradients,
)
from .training.losses import normal_consistency as normal_consistency, photometric_loss as photometric_loss
from .training.options import Corrections as Corrections
from .training.reports import Display as Display, Progress as Progress, RestOfRun as RestOfRun
from .training.stage import LossTerm as LossTerm

__version__: str
