"""Scores up to exposure and pose: the fit of colours, the alignment of test cameras, and runs that learn both."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from small_values import moved_by

from a2tg_jax import (
    Corrections,
    Exposure,
    Gaussians2dMcmc,
    Mcmc,
    RenderSettings,
    align_poses,
    color_fit,
    evaluate,
    fit,
    synthetic_scene,
)
from a2tg_jax.cli.main import main
from a2tg_jax.measure import alignment

TWIST = np.array([0.018, -0.012, 0.009, 0.012, -0.009, 0.015])


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(num_views=10, width=60, height=44, num_points=400)


@pytest.fixture(scope="module")
def system():
    return Gaussians2dMcmc(stage1_iterations=150, initial_opacity=0.5, densify=Mcmc(cap=420))


@pytest.fixture(scope="module")
def model(scene, system):
    return fit(scene, system).model


def moved(view, twist):
    viewmat = jnp.asarray(moved_by(twist, view.camera.viewmat))
    return dataclasses.replace(view, camera=dataclasses.replace(view.camera, viewmat=viewmat))


def shift(scene, view, other):
    """Mean distance in pixels of what two cameras see of the scene's points."""

    def seen(camera):
        viewmat = np.asarray(camera.viewmat)
        K = np.asarray(camera.K)
        points = (scene.points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
        return points[:, :2] / points[:, 2:]

    return np.linalg.norm(seen(view.camera) - seen(other.camera), axis=1).mean()


def test_a_known_map_of_colours_is_found():
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 1, (12, 10, 3))
    known = np.concatenate([np.eye(3) + 0.2 * rng.normal(size=(3, 3)), rng.normal(size=(3, 1))], axis=1)
    target = image @ known[:, :3].T + known[:, 3]
    np.testing.assert_allclose(color_fit(image, target), known, atol=1e-9)
    mask = rng.uniform(size=(12, 10)) < 0.5
    target[~mask] = 7
    np.testing.assert_allclose(color_fit(image, target, mask), known, atol=1e-9)


@pytest.mark.long
def test_scores_with_colours_fitted_do_not_see_an_exposure(scene, model):
    """Photographs under another exposure have the same scores, up to the rounding to 8 bits, but only with the fit."""
    views = scene.test
    darker = tuple(dataclasses.replace(view, picture=(view.image * 0.6 + 20).astype(np.uint8)) for view in views)
    plain = evaluate(views, model)
    fitted = evaluate(views, model, fit_colors=True)
    assert fitted.psnr > plain.psnr
    again = evaluate(darker, model, fit_colors=True)
    assert again.psnr + 20 * np.log10(0.6) == pytest.approx(fitted.psnr, abs=0.4)
    assert evaluate(darker, model).psnr < again.psnr - 3


@pytest.mark.long
def test_a_disturbed_test_camera_comes_back(scene, model):
    """To within a quarter of a pixel, where the photographs are the model's own."""
    drawn = [np.clip(np.rint(255 * model.render(view.camera).color), 0, 255).astype(np.uint8) for view in scene.test]
    own = [dataclasses.replace(view, picture=image) for view, image in zip(scene.test, drawn, strict=True)]
    disturbed = [moved(view, TWIST) for view in own]
    aligned = align_poses(disturbed, model)

    def shifts(views):
        return [shift(scene, *pair) for pair in zip(views, scene.test, strict=True)]

    assert min(shifts(disturbed)) > 1.5 and max(shifts(aligned)) < 0.25
    assert evaluate(disturbed, model).psnr < 30 < 40 < evaluate(aligned, model).psnr


@pytest.mark.long
def test_alignment_finds_room_for_what_it_sees(scene, model, monkeypatch):
    (view,) = align_poses(scene.test[:1], model, num_steps=3)
    monkeypatch.setattr(alignment, "plan_render", lambda *_, **options: RenderSettings(capacity=64))
    (again,) = align_poses(scene.test[:1], model, num_steps=3)
    np.testing.assert_array_equal(again.camera.viewmat, view.camera.viewmat)


@pytest.mark.long
def test_masked_pixels_do_not_pull_at_a_camera(scene, model):
    view = moved(scene.test[0], TWIST)
    mask = np.ones(view.picture.size, bool)
    mask[:20] = False
    noise = np.random.default_rng(0).integers(0, 256, view.image.shape).astype(np.uint8)
    noisy = np.where(mask[..., None], view.image, noise)
    clean, other = (
        align_poses([dataclasses.replace(view, picture=picture, mask=mask)], model, num_steps=20)[0].camera.viewmat
        for picture in (view.image, noisy)
    )
    np.testing.assert_array_equal(clean, other)
    assert np.abs(clean - view.camera.viewmat).max() > 1e-3


@pytest.mark.long
def test_exposures_win_back_what_known_ones_took(scene, system, model):
    rng = np.random.default_rng(0)

    def disturbed(view):
        known.append(rng.uniform(0.5, 1.5))
        return dataclasses.replace(view, picture=np.clip(known[-1] * view.image, 0, 255).astype(np.uint8))

    known: list[float] = []
    changed = dataclasses.replace(scene, train=tuple(map(disturbed, scene.train)))
    asked = dataclasses.replace(system, exposure=True, corrections=Corrections(affine=Exposure(rate=3e-2)))
    plain, corrected = (fit(changed, chosen).model for chosen in (system, asked))
    learned = corrected.origin.corrections["exposure"][: len(known)]
    assert np.corrcoef(known, np.trace(learned[:, :, :3], axis1=1, axis2=2))[0, 1] > 0.9
    scores = [evaluate(scene.test, found, fit_colors=True).psnr for found in (plain, corrected)]
    assert scores[1] > scores[0] + 0.3


@pytest.mark.long
def test_a_run_reports_both_scores_and_what_it_learned(tmp_path, capsys):
    out = tmp_path / "run"
    arguments = "train synthetic --system gaussians-2d-mcmc --preset smoke --downscale 8 --stage1-iterations 12 "
    arguments += "--exposure --refine-poses --initial-gaussians 200 --densify.cap 210 --out"
    assert main([*arguments.split(), str(out)]) == 0
    printed = capsys.readouterr().out
    metrics = json.loads((out / "metrics.json").read_text())["models"]
    for measured in metrics.values():
        for split in ("test", "train"):
            for way in ("", "_color_fit", "_aligned", "_aligned_color_fit"):
                assert np.isfinite(measured[f"{split}{way}"]["psnr"])
        assert measured["test_aligned_color_fit"]["psnr"] >= measured["test"]["psnr"]
    for title in ("test, colours fitted: PSNR (dB)", "train, poses aligned: SSIM"):
        assert title in printed and title in (out / "report.html").read_text()
    (file,) = (out / "corrections").glob("*.json")
    learned = json.loads(file.read_text())
    assert len(learned) == metrics[file.stem]["train"]["views"]
    for view in learned.values():
        assert np.shape(view["exposure"]) == (3, 4) and np.shape(view["pose"]) == (6,)
