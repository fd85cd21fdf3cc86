"""Which bits are kept: losses measured, a ladder of choices, the smallest file within a loss, and the command."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from small_files import compact_bytes
from small_models import origin_of
from small_values import some_gaussians

from a2tg_jax import (
    CompactChoices,
    Model,
    Trial,
    evaluate,
    init_from_points,
    load_compact,
    loss_beside_renders,
    loss_on_views,
    measure_choices,
    save_model,
    smallest_within,
    synthetic_scene,
)
from a2tg_jax.base.text import in_bytes
from a2tg_jax.cli import main as cli
from a2tg_jax.finish import compaction
from a2tg_jax.finish.compaction import best_within, try_choices
from a2tg_jax.results import compression

SCENE = synthetic_scene(num_views=6, width=24, height=18, num_points=300)
SMALL = {"means": (4, 8, 16), "opacities": (2, 10), "sh_0": (3, 8), "sh_rest": (3, 8), "texels": (3, 8)}


pytestmark = pytest.mark.usefixtures("untouched_jax")


def a_model() -> Model:
    gaussians = init_from_points(SCENE.points, SCENE.colors, opacity=0.8, sh_degree=0)
    rng = np.random.default_rng(0)
    logits = jnp.asarray(rng.normal(size=gaussians.num) + 1, jnp.float32)
    return Model(dataclasses.replace(gaussians, logit_opacities=logits), origin=origin_of(SCENE))


def test_losses_are_differences_of_psnr_and_of_renders():
    model = a_model()
    spoiled = dataclasses.replace(model, gaussians=dataclasses.replace(model.gaussians, sh=model.gaussians.sh + 0.3))
    wanted = evaluate(SCENE.train, model).psnr - evaluate(SCENE.train, spoiled).psnr
    loss = loss_on_views(model, SCENE.train)
    cameras = model.origin.cameras[:2]
    assert loss(spoiled) == pytest.approx(wanted, abs=1e-3) and abs(wanted) > 0.05 and loss(model) == 0
    # Without photographs, errors add up.
    loss = loss_beside_renders(model, cameras, assumed_psnr=20.0)
    pairs = [[np.clip(m.render(camera).color, 0, 1) for m in (model, spoiled)] for camera in cameras]
    wanted = np.mean([10 * np.log10(1 + float(np.mean((a - b) ** 2)) / 0.01) for a, b in pairs])
    assert loss(spoiled) == pytest.approx(wanted, rel=1e-4) and loss(model) == 0
    with pytest.raises(ValueError, match="views must hold at least one view"):
        loss_on_views(model, [])
    with pytest.raises(ValueError, match="there are no views"):
        loss_beside_renders(model, [])


def test_the_smallest_file_loses_no_more_than_it_may():
    model = a_model()
    loss = loss_on_views(model, SCENE.train)
    trials = measure_choices(model, [loss], SMALL)
    assert [(trial.group, trial.precision) for trial in trials] == [
        ("means", 4), ("means", 8), ("means", 16), ("opacities", 2), ("opacities", 10), ("sh_0", 3), ("sh_0", 8),
    ]  # fmt: skip
    assert all(trial.num_bytes == len(compact_bytes(model, trial.choices)) for trial in trials)
    assert trials[0].num_bytes < trials[2].num_bytes and trials[0].losses[0] > trials[2].losses[0]
    found = [smallest_within(model, [loss], most, trials) for most in (0.02, 0.2, 5.0)]
    assert all(trial.losses[0] <= most for trial, most in zip(found, (0.02, 0.2, 5.0), strict=True))
    sizes = [trial.num_bytes for trial in found]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < sizes[0]
    with pytest.raises(ValueError, match=r"max_loss must be .* dB or more"):
        smallest_within(model, [lambda _: 1.0], 0.5, trials)


def test_greed_takes_what_saves_most_for_its_loss_and_stays_within():
    def trial(num_bytes, loss, **kept):
        ((group, _),) = kept.items()
        return Trial(CompactChoices().keeping(kept), num_bytes, (loss,), group)

    means = [trial(80, 0.5, means=4), trial(90, 0.02, means=8), trial(100, 0.0, means=12)]
    quats = [trial(50, 0.06, quats=4), trial(95, -0.01, quats=8), trial(100, 0.0, quats=10)]
    path = compaction._descent({"means": means, "quats": quats}, 0.07)
    assert path == [{"means": 12, "quats": 8}, {"means": 12, "quats": 4}]
    assert compaction._descent({"means": means, "quats": quats}, 0.09)[-1] == {"means": 8, "quats": 4}


def test_the_command_on_a_model(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(compression, "LADDER", SMALL)
    save_model(tmp_path / "scene.npz", a_model())
    assert cli.main(["compress", str(tmp_path / "scene.npz"), "--max-loss", "0.3"]) == 0
    text = capsys.readouterr().out
    size = (tmp_path / "scene.a2tgz").stat().st_size
    assert load_compact(tmp_path / "scene.a2tgz").num == a_model().num
    part = f"1/{a_model().num_bytes / size:.1f}"
    assert text.startswith("trying up to ") and "on a CPU this takes minutes\n" in text
    printed = f"{tmp_path / 'scene.a2tgz'}: {in_bytes(size)} on disk, {part} of the model's numbers, 0."
    assert text.splitlines()[-1].startswith(printed) and text.endswith(" dB of PSNR lost\n")
    assert text.count("\n") == 2
    assert cli.main(["compress", str(tmp_path / "scene.npz"), "--max-loss", "0.3", "--overwrite", "--verbose"]) == 0
    text = capsys.readouterr().out
    assert "dB lost, for a model of 30 dB" in text and "opacities 2 " in text and "texels" not in text


@pytest.mark.parametrize(
    ("model", "flags", "words"),
    [
        (a_model, ("--tune-iterations", "10"), "--tune-iterations needs the photographs of a run folder"),
        (lambda: Model(some_gaussians()), (), "the model has no cameras to measure a loss with"),
        (None, (), "no such"),
    ],
)
def test_the_command_refuses_what_it_cannot_measure(model, flags, words, tmp_path, capsys):
    if model is not None:
        save_model(tmp_path / "scene.npz", model())
    assert cli.main(["compress", str(tmp_path / "scene.npz"), *flags]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.glob("*.a2tgz"))


def test_the_best_file_within_some_bytes():
    model = a_model()
    loss = loss_on_views(model, SCENE.train)
    trials = measure_choices(model, [loss], SMALL)
    sizes = sorted({trial.num_bytes for trial in trials})
    budgets = [sizes[-1], (sizes[0] + sizes[-1]) // 2, sizes[0]]
    found = [try_choices(model, best_within(model, most, trials), [loss]) for most in budgets]
    assert all(trial.num_bytes <= most for trial, most in zip(found, budgets, strict=True))
    losses = [trial.losses[0] for trial in found]
    assert losses == sorted(losses) and losses[0] < losses[-1]
    # No combination of these steps that fits loses less than a third of what was chosen.
    others = [
        try_choices(model, compaction.finest_choices().keeping({"means": a, "opacities": b, "sh_0": c}), [loss])
        for a in SMALL["means"] for b in SMALL["opacities"] for c in SMALL["sh_0"]
    ]  # fmt: skip
    for most, chosen in zip(budgets, found, strict=True):
        best = min(trial.losses[0] for trial in others if trial.num_bytes <= most)
        assert chosen.losses[0] <= 3 * max(best, 0.001)
    with pytest.raises(ValueError, match=r"file_budget must be at least [\d.]+ kB, the size of the smallest file"):
        best_within(model, 100, trials)
