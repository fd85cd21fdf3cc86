"""Training from photographs: stage 1 places the Gaussians, stage 2 gives them textures.

`fit` runs both. The loop is on the host and reads top to bottom; everything per pixel is in `step.train_step`.
"""

import dataclasses
import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax.adapt import GradientStatistics, event_budget, next_sizes, reallocate, select
from a2tg_jax.appearance import TextureOptions
from a2tg_jax.batches import BatchOrder, make_batch
from a2tg_jax.checkpoint import Checkpoint, History
from a2tg_jax.checkpoint import load_checkpoint as load_checkpoint
from a2tg_jax.checkpoint import save_checkpoint as save_checkpoint
from a2tg_jax.config import TrainConfig
from a2tg_jax.data.scene import Scene, View
from a2tg_jax.gaussians import Gaussians, init_from_points
from a2tg_jax.metrics import parameter_bytes
from a2tg_jax.optim import AdamState
from a2tg_jax.progress import ProgressBar
from a2tg_jax.render import RenderSettings, appearance_of, capacity_for, pairs_of_view
from a2tg_jax.schedule import num_reachable, upscale_iterations
from a2tg_jax.step import StepInfo, StepSettings, TrainState, initial_state, jitted_step
from a2tg_jax.texture import AtlasLayout, Textures, allocate_textures

BYTES_PER_PLAIN_GAUSSIAN = 232 + 16
PLANNED_VIEWS = 64
GROWTH_ROOM = 1.5
"""How many times the pairs of the first image the lists of a stage have room for."""
LOG_EVERY = 10
NO_ROW_LOG_SCALE = -10.0


@dataclasses.dataclass(frozen=True)
class FitResult:
    """What training leaves."""

    gaussians: Gaussians
    """The live Gaussians only, in the normalised world of the scene."""
    textures: Textures | None
    layout: AtlasLayout | None
    history: History
    config: TrainConfig
    stage1: Gaussians | None
    """The live Gaussians at the end of stage 1; None where training was resumed in stage 2."""
    seconds: float
    """Training time in all, compilation included."""
    num_regrown: int
    """How often the tile lists needed more room, each time at the price of a compilation."""


OnCheckpoint = Callable[[Checkpoint], None]


def fit(
    scene: Scene,
    config: TrainConfig = TrainConfig.quick(),  # noqa: B008 - frozen
    *,
    resume: Checkpoint | None = None,
    on_checkpoint: OnCheckpoint | None = None,
    checkpoint_every: int | None = None,
    progress: bool = True,
) -> FitResult:
    """Trains a scene: stage 1, then stage 2 from its result.

    Args:
      scene: from `load_scene` or `synthetic_scene`.
      config: every number; `TrainConfig.paper()` and `TrainConfig.quick()` are presets.
      resume: a checkpoint of the same configuration to go on from.
      on_checkpoint: called with the state every `checkpoint_every` iterations and at the end of each stage. The next
        iteration takes over the state's buffers, so save it there and then, or copy it.
      checkpoint_every: None: at the end of each stage only.
      progress: show a progress bar.

    Raises:
      ValueError: if the configuration contradicts itself or the checkpoint, or the loss stops being finite.
    """
    options = {"on_checkpoint": on_checkpoint, "checkpoint_every": checkpoint_every, "progress": progress}
    if resume is not None and resume.stage == 2:
        return fit_stage2(scene, resume.live_gaussians, config, resume=resume, **options)  # type: ignore[arg-type]
    first = fit_stage1(scene, config, resume=resume, **options)  # type: ignore[arg-type]
    second = fit_stage2(scene, first.gaussians, config, **options)  # type: ignore[arg-type]
    history = first.history.followed_by(second.history)
    return dataclasses.replace(
        second,
        history=history,
        stage1=first.gaussians,
        seconds=first.seconds + second.seconds,
        num_regrown=first.num_regrown + second.num_regrown,
    )


def fit_stage1(
    scene: Scene,
    config: TrainConfig,
    *,
    resume: Checkpoint | None = None,
    on_checkpoint: OnCheckpoint | None = None,
    checkpoint_every: int | None = None,
    progress: bool = True,
) -> FitResult:
    """Stage 1: plain 2D Gaussians from the scene's points, with MCMC densification. Arguments as in `fit`."""
    check_config(config)
    gaussians, num_live = _allocate(scene, config)
    run = _Stage(scene, config, 1, initial_state(gaussians, num_live, None, False), None, resume)
    run.train(on_checkpoint, checkpoint_every, progress)
    return run.result(stage1=run.live_gaussians)


def fit_stage2(
    scene: Scene,
    gaussians: Gaussians,
    config: TrainConfig,
    *,
    resume: Checkpoint | None = None,
    on_checkpoint: OnCheckpoint | None = None,
    checkpoint_every: int | None = None,
    progress: bool = True,
) -> FitResult:
    """Stage 2: textures on the Gaussians of stage 1, or without textures the same training for comparison.

    Args as in `fit`; `gaussians` [N] are all live.
    """
    check_config(config)
    textures, layout = None, None
    if config.texture.is_enabled:
        options = texture_options(config)
        textures, layout = allocate_textures(np.ones((gaussians.num, 2), np.int64), rgb=options.initial_rgb)
        _check_budget(config, gaussians.num)
    has_events = bool(upscale_iterations(config.texture, config.stage2_iterations))
    # Steps take over the buffers they are given: the caller keeps his own.
    state = initial_state(jax.tree.map(jnp.array, gaussians), gaussians.num, textures, has_events)
    run = _Stage(scene, config, 2, state, layout, resume)
    run.train(on_checkpoint, checkpoint_every, progress)
    return run.result(stage1=gaussians if resume is None else None)


def render_settings(config: TrainConfig) -> RenderSettings:
    """The settings that a configuration's scenes are rendered with, without a capacity."""
    return RenderSettings(tile_size=config.tile_size, sh_degree=config.sh_degree, texture=texture_options(config))


def texture_options(config: TrainConfig) -> TextureOptions:
    """How a configuration's textures are read."""
    return TextureOptions.official() if config.texture.official else TextureOptions()


class _Stage:
    """One stage under way: the state, and what the host keeps beside it."""

    def __init__(self, scene, config: TrainConfig, stage: int, state: TrainState, layout, resume: Checkpoint | None):
        self.views: tuple[View, ...] = scene.train
        self.config, self.stage, self.state, self.layout = config, stage, state, layout
        self.history, self.earlier_seconds = History.empty(), 0.0
        if resume is not None:
            _check_resume(resume, config, stage)
            self.state = jax.tree.map(jnp.array, resume.state)
            self.layout, self.history = resume.layout, resume.history
            self.earlier_seconds = resume.history.last_seconds
        self.scene_scale = jnp.asarray(scene.scale, jnp.float32)
        self.key = jax.random.fold_in(jax.random.key(config.seed), stage)
        self.order = BatchOrder(self.views, config.batch_size, config.seed * 2 + stage)
        self.events = upscale_iterations(config.texture, config.stage2_iterations) if stage == 2 else ()
        self.capacities: dict[tuple[int, int], int] = {}
        self.batch_of = functools.lru_cache(maxsize=2)(lambda indices: make_batch(self.views, indices))
        self.started = time.perf_counter()
        self.num_regrown = 0

    def result(self, stage1: Gaussians | None) -> FitResult:
        """What the stage leaves."""
        return FitResult(
            gaussians=self.live_gaussians,
            textures=self.state.textures,
            layout=self.layout,
            history=self.history,
            config=self.config,
            stage1=stage1,
            seconds=self.seconds,
            num_regrown=self.num_regrown,
        )

    @property
    def seconds(self) -> float:
        return self.earlier_seconds + time.perf_counter() - self.started

    @property
    def num_iterations(self) -> int:
        return self.config.stage1_iterations if self.stage == 1 else self.config.stage2_iterations

    @property
    def live_gaussians(self) -> Gaussians:
        return self.state.gaussians[: int(self.state.num_live)]

    def train(self, on_checkpoint: OnCheckpoint | None, checkpoint_every: int | None, progress: bool) -> None:
        """Runs the stage to its end."""
        start = int(self.state.iteration)
        with ProgressBar(f"stage {self.stage}", start, self.num_iterations, is_shown=progress) as bar:
            for iteration in range(start + 1, self.num_iterations + 1):
                info = self.step(iteration)
                if iteration in self.events:
                    self.upscale(self.events.index(iteration) + 1)
                if iteration % LOG_EVERY == 0 or iteration == self.num_iterations:
                    self.history = self.history.with_point(
                        self.stage, iteration, float(info.loss), float(info.psnr),
                        int(self.state.num_live), self.megabytes, self.seconds,
                    )  # fmt: skip
                bar.update(info, self.history)
                is_due = checkpoint_every is not None and iteration % checkpoint_every == 0
                if on_checkpoint is not None and (is_due or iteration == self.num_iterations):
                    on_checkpoint(Checkpoint(self.config, self.stage, self.state, self.layout, self.history))

    def step(self, iteration: int) -> StepInfo:
        """One iteration, repeated with more room while the tile lists overflow."""
        indices = self.order.indices(iteration)
        size = self.views[indices[0]].image.shape[:2]
        while True:
            how = StepSettings(self.config, self.stage, self._settings(size))
            self.state, info = jitted_step()(
                how, self.state, self.batch_of(indices), self.layout, self.scene_scale, self.key
            )
            if not bool(info.is_overflow):
                break
            self.num_regrown += 1
            self.capacities[size] = capacity_for(int(float(info.num_pairs) * GROWTH_ROOM))
        names = ", ".join(self.views[index].name for index in indices)
        if not bool(info.is_finite):
            raise ValueError(
                f"loss or gradient is not finite at iteration {iteration} of stage {self.stage}, view {names}: lower "
                "the learning rates, or look for a damaged camera or image; the state before it is unharmed"
            )
        if not bool(info.has_hosts):
            raise ValueError(
                f"no Gaussian above the death opacity is left at iteration {iteration} of stage {self.stage}: check "
                "the cameras and points of the scene, or lower rates.logit_opacities"
            )
        return info

    @property
    def megabytes(self) -> float:
        """Reported memory of the live Gaussians and their texels, in 10⁶ bytes."""
        texels = 0 if self.layout is None else self.layout.num_texels
        return (232 * int(self.state.num_live) + 16 * texels) / 1e6

    def upscale(self, event: int) -> None:
        """One upscaling event: choose, rebuild the buckets with their moments, restart the statistic."""
        state, layout, adam, chosen = self.state, self.layout, self.state.texture_moments, self.config.texture
        if layout is None or state.textures is None or adam is None or state.statistics is None:
            raise ValueError("the checkpoint has no textures, but its configuration asks for them")
        sizes = layout.sizes
        proposed = next_sizes(
            sizes,
            np.asarray(state.gaussians.scales),
            k_a=chosen.k_a,
            k_s=chosen.k_s,
            cap=chosen.cap,
            anisotropic=chosen.anisotropic,
        )
        used = parameter_bytes(state.gaussians, layout)
        rule = _rule(self.config, used, event, len(self.events))
        mask = select(np.asarray(state.statistics.average()), sizes, proposed, **rule)
        new_sizes = np.where(mask[:, None], proposed, sizes)
        rebuilt = reallocate(state.textures, layout, new_sizes, (adam.mu, adam.nu))
        mu, nu = rebuilt.moments
        is_last = event == len(self.events)
        self.layout = rebuilt.layout
        self.state = dataclasses.replace(
            state,
            textures=rebuilt.textures,
            texture_moments=AdamState(mu, nu, adam.count),
            statistics=None if is_last else GradientStatistics.init(state.gaussians.num),
        )

    def _settings(self, size: tuple[int, int]) -> RenderSettings:
        """Render settings with the capacity for views of a size, planned before the first of them."""
        settings = render_settings(self.config)
        if size not in self.capacities:
            views = [view for view in self.views if view.image.shape[:2] == size]
            live = self.live_gaussians
            rule = appearance_of(live, self.state.textures, self.layout, settings)
            sample = views[:: -(-len(views) // PLANNED_VIEWS)]
            pairs = max(pairs_of_view(live, view.camera, rule, settings) for view in sample)
            growth = (self.state.gaussians.num / max(live.num, 1)) ** 0.5
            self.capacities[size] = capacity_for(int(pairs * GROWTH_ROOM * growth))
        return dataclasses.replace(settings, capacity=self.capacities[size])


def _rule(config: TrainConfig, used_bytes: int, event: int, num_events: int) -> dict[str, float]:
    """The keyword that tells `select` how to choose."""
    chosen = config.texture
    if chosen.select == "budget":
        total = (chosen.budget_mb or 0.0) * 1e6
        return {"budget_bytes": event_budget(total, used_bytes, event, num_events)}
    return {chosen.select: getattr(chosen, chosen.select)}


def _allocate(scene: Scene, config: TrainConfig) -> tuple[Gaussians, int]:
    """The initial Gaussians in arrays with room for all that growth can reach, and how many there are."""
    cap = config.densify.cap
    num = min(len(scene.points), cap, config.initial_gaussians or cap)
    initial = init_from_points(scene.points, scene.colors, num, config.seed)
    room = num
    if config.densify.is_enabled:
        room = num_reachable(num, cap, config.stage1_iterations)
    empty = Gaussians(
        means=jnp.zeros((room - num, 3)),
        quats=jnp.tile(jnp.asarray([[1.0, 0.0, 0.0, 0.0]]), (room - num, 1)),
        log_scales=jnp.full((room - num, 2), NO_ROW_LOG_SCALE),
        logit_opacities=jnp.full(room - num, NO_ROW_LOG_SCALE),
        sh=jnp.zeros((room - num, 16, 3)),
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), initial, empty), num


def check_config(config: TrainConfig) -> None:
    """Refuses what cannot be trained before any time is spent.

    Raises:
      ValueError: naming the number, what was wanted and what came.
    """
    if config.stage1_iterations < 1 or config.stage2_iterations < 1:
        raise ValueError("stage1_iterations and stage2_iterations must be at least 1")
    if config.batch_size < 1:
        raise ValueError(f"batch_size must be at least 1; got {config.batch_size}")
    if config.densify.cap < 2:
        raise ValueError(f"densify.cap must be at least 2 Gaussians; got {config.densify.cap}")
    if not 0 <= config.sh_degree <= 3:
        raise ValueError(f"sh_degree must lie in 0..3; got {config.sh_degree}")
    if not 1 <= config.texture.cap <= 16:
        raise ValueError(f"texture.cap must lie in 1..16; got {config.texture.cap}")
    upscale_iterations(config.texture, config.stage2_iterations)
    if config.texture.is_enabled and config.texture.select == "budget" and config.texture.budget_mb is None:
        raise ValueError("texture.select is 'budget', so texture.budget_mb must say how many MB (10^6 bytes)")


def _check_budget(config: TrainConfig, num: int) -> None:
    needed = BYTES_PER_PLAIN_GAUSSIAN * num / 1e6
    budget = config.texture.budget_mb
    if config.texture.select == "budget" and budget is not None and budget < needed:
        raise ValueError(
            f"texture.budget_mb is {budget:g}, but {num} Gaussians with 1×1 textures already take {needed:.3f} MB: "
            f"raise the budget, or lower densify.cap to {int(budget * 1e6 // BYTES_PER_PLAIN_GAUSSIAN)}"
        )


def _check_resume(resume: Checkpoint, config: TrainConfig, stage: int) -> None:
    if resume.stage != stage:
        raise ValueError(f"the checkpoint is of stage {resume.stage}, but stage {stage} was to go on")
    if resume.config != config:
        raise ValueError("the checkpoint was made with another configuration: resume with checkpoint.config")
