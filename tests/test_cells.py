"""The property of the whole idea: where details are fine, textures show more for their bytes than Gaussians do."""

import pytest

import a2tg_jax as a2tg

BUDGET = "0.1MB"
ITERATIONS = {"stage1_iterations": 1000, "stage2_iterations": 1000}


@pytest.mark.long
def test_textures_beat_plain_gaussians_of_equal_bytes_and_training_on_fine_cells():
    scene, found = a2tg.cells_scene(), {}
    for kind in (a2tg.Gaussians2dMcmc, a2tg.A2tg):
        system = kind.preset("quick", memory_budget=BUDGET, sh_degree=3, **ITERATIONS)
        model = a2tg.fit(scene, system, progress=False).model
        assert 0.99e5 < model.num_bytes <= 1e5
        found[kind] = a2tg.evaluate(scene.test, model)
    plain, textured = found.values()
    assert plain.psnr > 19, "plain Gaussians show something as well"
    assert textured.psnr > plain.psnr + 0.5  # 0.97 when written
    assert textured.ssim > plain.ssim + 0.03  # 0.053
