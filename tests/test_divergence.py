"""Numbers that are not finite and losses that explode: found, named and undone; stops at the ends of a stage."""

import dataclasses
import pickle
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from a2tg_jax import (
    Appearance,
    Bands,
    Change,
    DivergedError,
    Gaussians2dMcmc,
    History,
    Interrupted,
    LossConfig,
    Mcmc,
    StepEvent,
    allocate_appearance,
    fit,
    init_from_points,
    load_checkpoint,
    pytree,
    save_checkpoint,
    stop_on_signals,
    synthetic_scene,
)
from a2tg_jax.training import step
from a2tg_jax.training.batches import BatchOrder
from a2tg_jax.training.divergence import _not_finite, largest_loss
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.start import initial_model

SIZES = {"initial_gaussians": 60, "densify": Mcmc(cap=60), "sh_degree": 0, "loss": LossConfig(ssim_weight=0.0)}
"""Small, in numbers and in what is compiled."""
BAD_ROW = 7


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(num_views=8, width=40, height=30, num_points=150)


@pytree
class Poison(StepEvent):
    """After one iteration, a row becomes NaN."""

    iteration: int = 12

    def apply(self, now, model, moments, state):
        is_bad = (now.iteration == self.iteration) & (jnp.arange(model.gaussians.num) == BAD_ROW)
        log_scales = jnp.where(is_bad[:, None], jnp.nan, model.gaussians.log_scales)
        gaussians = dataclasses.replace(model.gaussians, log_scales=log_scales)
        return Change(dataclasses.replace(model, gaussians=gaussians), moments, state)


@pytree
class Brighten(StepEvent):
    """After every iteration, colours double."""

    def apply(self, now, model, moments, state):
        gaussians = dataclasses.replace(model.gaussians, sh=2 * model.gaussians.sh)
        return Change(dataclasses.replace(model, gaussians=gaussians), moments, state)


@dataclasses.dataclass(frozen=True, kw_only=True)
class WithEvent(Gaussians2dMcmc):
    """One stage with one of these events."""

    bright: bool = False

    def stages(self):
        (stage,) = super().stages()
        return (dataclasses.replace(stage, events=(*stage.events, Brighten() if self.bright else Poison())),)


def test_what_is_not_finite_is_named_and_the_state_before_is_kept(scene, tmp_path):
    system = WithEvent(stage1_iterations=20, **SIZES)
    with pytest.raises(DivergedError) as raised:
        fit(scene, system)
    text = str(raised.value)
    assert "not finite at iteration 12 of stage gaussians, view " in text and "\n" not in text
    assert f"after the step, log_scales is not finite in 1 of 60 rows ({BAD_ROW})" in text
    save_checkpoint(tmp_path / "kept.npz", raised.value.checkpoint)
    kept = load_checkpoint(tmp_path / "kept.npz", WithEvent)
    assert kept.iteration == 11 and np.isfinite(kept.model.gaussians.log_scales).all()
    # From another process, as of a sweep.
    sent = pickle.loads(pickle.dumps(raised.value))
    assert str(sent) == text and sent.checkpoint.iteration == 11


def test_tables_without_rows_are_finite():
    """The tables of `bytewise` have no rows until a Gaussian gets a degree."""
    gaussians = init_from_points(np.eye(3), np.zeros((3, 3)), sh_degree=0)
    appearance = allocate_appearance(Appearance(bands=Bands()), jax.random.key(0), gaussians)
    assert not appearance.coefficients.buckets[0].size
    assert not list(_not_finite((gaussians, appearance, ())))


def test_parameters_that_nothing_but_adam_changed_are_not_checked_again(scene, monkeypatch):
    """Gradients show that they are finite. What events made is checked, row by row."""
    sizes = []
    monkeypatch.setattr(jax.lax, "optimization_barrier", lambda rows: sizes.append(rows.size) or rows)
    system = Gaussians2dMcmc(stage1_iterations=10, **SIZES)
    run = StageRun(scene, system, 0, initial_model(scene, system))
    settings, state, inputs = run.arguments(1)
    settings = dataclasses.replace(settings, happens=(True,))
    stage = dataclasses.replace(inputs.stage, events=(Brighten(),))
    state = dataclasses.replace(state, events=(None,))
    inputs = inputs._replace(stage=stage, clock=stage.clock(1))
    jax.eval_shape(lambda state: step.attempt(settings, state, inputs), state)
    assert sizes == [1 + 5 * 60 + 60], "the loss, five gradients and the colours"


@pytest.mark.long
def test_an_explosion_is_seen_in_the_step(scene):
    with pytest.raises(
        DivergedError, match=r"exploded at iteration \d+ of stage .*, view \S+: the loss of \S+ is \d"
    ) as raised:
        fit(scene, WithEvent(bright=True, stage1_iterations=60, **SIZES))
    before = raised.value.checkpoint
    assert 10 < before.iteration < 60 and before.history.loss[-1] < largest_loss(before.history)


def test_the_limit_of_the_loss_follows_the_first_logged_one():
    for losses, limit in (([0.01, 0.1], 10), ([3.0, 0.1], 300), ([], np.inf)):
        assert largest_loss(dataclasses.replace(History.empty(), loss=np.asarray(losses))) == limit


def test_each_restoration_has_another_order(scene):
    orders = [BatchOrder(scene.train, 1, 5, number) for number in (0, 1, 2)]
    seen = [tuple(order.indices(i)[0] for i in range(1, 22)) for order in orders]
    assert len(set(seen)) == 3 and all(sorted(s[:7]) == list(range(7)) for s in seen)
    assert seen[0] == tuple(BatchOrder(scene.train, 1, 5).indices(i)[0] for i in range(1, 22))


def test_ctrl_c_in_the_last_step_interrupts_too(scene):
    system = Gaussians2dMcmc(stage1_iterations=10, **SIZES)
    kept = []
    press = lambda row: signal.raise_signal(signal.SIGINT)  # noqa: E731
    with pytest.raises(Interrupted, match="after iteration 10 of stage 1") as stopped, stop_on_signals() as is_stopped:
        fit(scene, system, on_log=press, on_checkpoint=kept.append, is_stopped=is_stopped)
    assert [checkpoint.iteration for checkpoint in kept] == [10]
    resumed = fit(scene, system, resume=stopped.value.checkpoint)
    jax.tree.map(np.testing.assert_array_equal, resumed.model.gaussians, stopped.value.checkpoint.model.gaussians)


def test_a_stop_before_the_first_step_is_a_checkpoint(scene):
    system = Gaussians2dMcmc(stage1_iterations=10, **SIZES)
    kept = []
    with pytest.raises(Interrupted, match="after iteration 0 of stage 1"):
        fit(scene, system, on_checkpoint=kept.append, is_stopped=lambda: True)
    assert [checkpoint.iteration for checkpoint in kept] == [0]
