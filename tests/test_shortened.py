"""Training that is finished early: what is left of each stage is done in fewer steps, to the end of all schedules."""

import dataclasses

import jax
import numpy as np
import pytest
from bits import bits_of

import a2tg_jax as a2tg
from a2tg_jax import Session
from a2tg_jax.cli import main as cli
from a2tg_jax.results import stage_training
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.record import read_record
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.start import initial_model

SCENE = a2tg.synthetic_scene(num_views=6, width=40, height=30, num_points=150)
SYSTEM = a2tg.A2tg.preset(
    "smoke",
    stage1_iterations=1_500,
    stage2_iterations=1_200,
    sh_degree=1,
    initial_gaussians=100,
    densify=a2tg.Mcmc(cap=160),
    texture=a2tg.Upscale(at=(0.2, 0.4), fraction=0.5),
)
AT = 250


def shortened(session: Session, **options) -> tuple[a2tg.FitResult, list[a2tg.Checkpoint]]:
    """Train, and ask to finish early once iteration 250 of the first stage is logged."""
    kept = []

    def ask(row):
        session.is_shortened |= row["iteration"] == AT

    def keep(checkpoint):
        # The next iteration reuses the state's buffers.
        kept.append(dataclasses.replace(checkpoint, state=jax.tree.map(np.array, checkpoint.state)))

    result = a2tg.fit(SCENE, SYSTEM, session=session, on_log=ask, on_checkpoint=keep, checkpoint_every=300, **options)
    return result, kept


@pytest.fixture(scope="module")
def trained():
    return shortened(Session())


def test_schedules_reach_their_end(trained):
    result, kept = trained
    assert result.checkpoint.is_at_end
    assert result.model.num == 160
    assert max(map(max, result.model.textures.sizes)) > 1
    assert {checkpoint.shortened_at for checkpoint in kept} == {AT, 0}
    # 1,250 iterations are left of the first stage: a tenth is 125 steps. A tenth of 1,200 is 120.
    iterations = result.history.iteration[result.history.stage == 1]
    assert iterations[-1] == 1_500
    assert np.sum(iterations > AT) in (12, 13)
    assert np.sum(result.history.stage == 2) in (12, 13)


def test_a_resumed_training_has_the_same_bits(trained):
    result, kept = trained
    inside = [checkpoint for checkpoint in kept if checkpoint.stage == 0 and AT < checkpoint.iteration < 1_500]
    assert inside
    again = a2tg.fit(SCENE, SYSTEM, resume=inside[0])
    assert bits_of(again.model) == bits_of(result.model)


def test_checkpoints_do_not_change_it(trained):
    session = Session()

    def ask(row):
        session.is_shortened |= row["iteration"] == AT

    assert bits_of(a2tg.fit(SCENE, SYSTEM, session=session, on_log=ask).model) == bits_of(trained[0].model)


def test_a_checkpoint_keeps_from_where(trained, tmp_path):
    _, kept = trained
    a2tg.save_checkpoint(tmp_path / "a.npz", kept[0])
    assert a2tg.load_checkpoint(tmp_path / "a.npz").shortened_at == AT


def test_a_step_counts_as_many_iterations():
    """Each event happens at the first step that reaches its time, the last of several times once."""
    stage = SYSTEM.all_stages()[0]
    times = next(times for event, times in zip(stage.events, stage.times, strict=True) if len(times) < 1_500)
    place = stage.times.index(times)
    for stride in (1, 7, 1_000):
        happened = [stage.clock(at, stride=stride).num_left[place] for at in range(stride, 1_501, stride)]
        due = [sum(at - stride < time <= at for time in times) for at in range(stride, 1_501, stride)]
        assert [left > 0 for left in happened] == [num > 0 for num in due]
        assert [left for left in happened if left][-1] == 1 or stride == 1_000


def test_few_iterations_that_are_left_stay():
    run = StageRun(SCENE, SYSTEM, 0, initial_model(SCENE, SYSTEM), shortened_at=1_420)
    assert run.stride_after(1_420) == 1
    run = StageRun(SCENE, SYSTEM, 0, initial_model(SCENE, SYSTEM), shortened_at=0)
    assert run.stride_after(0) == 10


TINY = (
    *("--preset", "smoke", "--stage1-iterations", "220", "--stage2-iterations", "210", "--densify.cap", "60"),
    *("--initial-gaussians", "40", "--sh-degree", "0", "--downscale", "4", "--yes", "--system", "a2tg"),
)


@pytest.fixture
def interrupted_run(tmp_path, monkeypatch):
    """A run that was stopped after its first checkpoint."""
    save = stage_training.save_checkpoint

    def save_and_interrupt(path, checkpoint):
        save(path, checkpoint)
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "configure_cpu", lambda: None)
    with monkeypatch.context() as patch:
        patch.setattr(stage_training, "save_checkpoint", save_and_interrupt)
        assert cli.main(["train", "synthetic", "--out", str(tmp_path / "run"), *TINY]) == 130
    return RunFolder(tmp_path / "run")


@pytest.mark.long
@pytest.mark.usefixtures("untouched_jax")
def test_a_run_is_finished_early_and_repeated(interrupted_run, tmp_path, capsys):
    run = interrupted_run
    assert cli.main(["train", "--out", str(run.path), "--finish-now"]) == 2
    assert "add --resume" in capsys.readouterr().err
    assert cli.main(["train", "--out", str(run.path), "--resume", "--finish-now"]) == 0
    assert read_record(run).shortened_at == {"a2tg-gaussians": 22, "a2tg-textures": 0}
    assert cli.main(["info", str(run.path)]) == 0
    assert "finished early, from iteration 22" in capsys.readouterr().out
    assert "shortened_at.a2tg-gaussians" in run.report.read_text()
    again = RunFolder(tmp_path / "again")
    assert cli.main(["train", "--config", str(run.record), "--out", str(again.path)]) == 0
    assert bits_of(a2tg.load_model(again.model("a2tg-textures"))) == bits_of(
        a2tg.load_model(run.model("a2tg-textures"))
    )


def test_iterations_beyond_the_stage_are_refused(interrupted_run, capsys):
    text = interrupted_run.record.read_text()
    interrupted_run.record.write_text(f"{text}\n[shortened_at]\na2tg-gaussians = 500\n")
    assert cli.main(["info", str(interrupted_run.path)]) == 2
    assert "shortened_at.a2tg-gaussians must be an iteration" in capsys.readouterr().err


def test_a_recorded_iteration_repeats_the_training(trained):
    """`fit_stage` is as before up to the iteration from which the stage is shortened."""
    result, _ = trained
    again = a2tg.fit_stage(SCENE, SYSTEM, 0, shortened_at=AT)
    assert bits_of(again.model) == bits_of(result.stages[0].model)
