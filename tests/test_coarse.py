"""A stage that begins with photographs of half the width and height."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bits import bits_of

import a2tg_jax as a2tg
from a2tg_jax.scene import View
from a2tg_jax.training import batches, loop
from a2tg_jax.training.batches import Photographs, over_background
from a2tg_jax.training.cost import forecast_stages
from a2tg_jax.training.start import initial_model

SMALL = a2tg.synthetic_scene(num_views=4, width=24, height=18, num_points=80)
SYSTEM = a2tg.Gaussians2d.preset(
    "smoke", stage1_iterations=24, stage2_iterations=6, initial_gaussians=60, densify=a2tg.CloneSplitPrune(cap=500)
)


def doubled(scene: a2tg.Scene) -> a2tg.Scene:
    """Return the scene with each pixel as four equal ones, and a last row and column of another colour."""

    def of_view(view):
        pixels = np.kron(view.image, np.ones((2, 2, 1), np.uint8))
        pixels = np.pad(pixels, ((0, 1), (0, 1), (0, 0)), constant_values=99)
        camera = a2tg.resize_camera(view.camera, 2 * view.camera.width, 2 * view.camera.height)
        height, width = pixels.shape[:2]
        return View(view.name, dataclasses.replace(camera, width=width, height=height), pixels)

    return dataclasses.replace(scene, train=tuple(map(of_view, scene.train)))


def with_all_parts(scene: a2tg.Scene) -> a2tg.Scene:
    """Return the scene with opacities, masks, and the rays of a pinhole as those of a lens."""

    def of_view(view):
        height, width = view.picture.size
        alpha = np.where(np.arange(width) < width // 2, 90, 255) * np.ones((height, 1))
        alpha = alpha.astype(np.uint8)[..., None]
        mask = np.arange(height)[:, None] * np.ones((1, width)) >= height // 3
        y, x = np.mgrid[:height, :width] + 0.5
        camera = dataclasses.replace(view.camera, rays=jnp.asarray(np.stack([x, y], axis=-1), jnp.float32))
        return View(view.name, camera, np.concatenate([view.image, alpha], axis=2), mask)

    return dataclasses.replace(scene, train=tuple(map(of_view, scene.train)))


@pytest.fixture
def small_ones_are_halved(monkeypatch):
    monkeypatch.setattr(batches, "LEAST_HALVED", 16)


def first_stage(scene, system, **options):
    return a2tg.fit_stage(scene, system, 0, **options).model


@pytest.mark.usefixtures("small_ones_are_halved")
def test_it_trains_as_on_photographs_of_half_the_size():
    wanted = first_stage(SMALL, SYSTEM)
    system = dataclasses.replace(SYSTEM, coarse_share=1.0)
    assert system.stages()[0].num_coarse == 24
    found = first_stage(doubled(SMALL), system)
    # XLA rounds otherwise where it computes the cameras itself.
    jax.tree.map(
        lambda own, other: np.testing.assert_allclose(own, other, atol=1e-4), found.gaussians, wanted.gaussians
    )
    on_whole = first_stage(doubled(SMALL), SYSTEM)
    assert np.abs(np.asarray(on_whole.gaussians.means - wanted.gaussians.means)).max() > 1e-3


@pytest.mark.long
@pytest.mark.usefixtures("small_ones_are_halved")
def test_it_halves_opacities_masks_and_rays():
    pinholes = dataclasses.replace(SMALL, train=SMALL.train[:2])
    even = dataclasses.replace(pinholes, train=tuple(map(without_odd_pixels, doubled(pinholes).train)))
    system = dataclasses.replace(SYSTEM, background="white")
    wanted = first_stage(with_all_parts(pinholes), system).gaussians
    found = first_stage(with_all_parts(even), dataclasses.replace(system, coarse_share=1.0)).gaussians
    assert np.abs(np.asarray(found.means - wanted.means)).max() < 1e-4


def without_odd_pixels(view: View) -> View:
    height, width = (side - 1 for side in view.picture.size)
    return View(view.name, dataclasses.replace(view.camera, width=width, height=height), view.image[:height, :width])


@pytest.mark.usefixtures("small_ones_are_halved")
def test_later_iterations_see_whole_photographs(monkeypatch):
    sizes = []
    step = loop.jitted_step()

    def seen(settings, state, inputs):
        sizes.append(settings.is_halved)
        return step(settings, state, inputs)

    seen.lower = step.lower
    monkeypatch.setattr(loop, "jitted_step", lambda: seen)
    a2tg.fit(doubled(SMALL), dataclasses.replace(SYSTEM, coarse_share=0.25))
    assert sizes == [True] * 6 + [False] * 24


@pytest.mark.usefixtures("small_ones_are_halved")
@pytest.mark.parametrize("at", [4, 12])
def test_a_resumed_training_has_the_same_bits(at):
    scene = doubled(SMALL)
    system = dataclasses.replace(SYSTEM, coarse_share=0.4)
    kept = []

    def keep(checkpoint):
        # The next iteration reuses the state's buffers.
        kept.append(dataclasses.replace(checkpoint, state=jax.tree.map(np.array, checkpoint.state)))

    whole = a2tg.fit(scene, system, on_checkpoint=keep, checkpoint_every=4)
    (inside,) = [checkpoint for checkpoint in kept if (checkpoint.stage, checkpoint.iteration) == (0, at)]
    assert bits_of(a2tg.fit(scene, system, resume=inside).model) == bits_of(whole.model)


def test_small_photographs_stay_whole():
    scene = doubled(SMALL)
    wanted = first_stage(scene, SYSTEM)
    assert bits_of(first_stage(scene, dataclasses.replace(SYSTEM, coarse_share=1.0))) == bits_of(wanted)


@pytest.mark.usefixtures("small_ones_are_halved")
def test_both_programs_are_compiled_at_the_first_step_and_counted():
    """The mean time of a compilation is wrong otherwise, by which later ones are forecast."""
    scene = doubled(SMALL)
    # A number of rows that no other test has, because the programs of others are in JAX's cache.
    system = dataclasses.replace(SYSTEM, coarse_share=0.25, densify=a2tg.CloneSplitPrune(cap=470))
    run = loop.StageRun(scene, system, 0, initial_model(scene, system))
    run.steps(1, 1)
    assert run.effects.num_compiled == 2
    run.steps(2, 8)
    assert run.effects.num_compiled == 2
    whole = next(forecast_stages(scene, dataclasses.replace(system, coarse_share=0.0)))
    assert next(forecast_stages(scene, system)).num_programs == whole.num_programs + 1


@pytest.mark.usefixtures("small_ones_are_halved")
def test_memory_is_that_of_whole_photographs():
    """Training would otherwise be refused only after its coarse part."""
    scene = doubled(SMALL)
    needed = []
    for share in (0.0, 1.0):
        run = loop.StageRun(scene, dataclasses.replace(SYSTEM, coarse_share=share), 0, initial_model(scene, SYSTEM))
        run.steps(1, 1)
        needed.append(run.memory)
    assert needed[1] >= 0.9 * needed[0]


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_a_wrong_share_is_refused(share):
    with pytest.raises(ValueError, match="coarse_share must be"):
        dataclasses.replace(SYSTEM, coarse_share=share).check()


def test_more_iterations_see_whole_photographs():
    system = dataclasses.replace(SYSTEM, coarse_share=0.5, stage2_iterations=0, more=(10,))
    assert [stage.num_coarse for stage in system.all_stages()] == [12, 0]


@pytest.mark.usefixtures("small_ones_are_halved")
def test_masks_of_which_no_four_pixels_count(tmp_path):
    """No pixel of the halved photographs counts, so that there is no error."""
    is_odd = np.indices((18, 24)).sum(0) % 2 == 1
    masked = dataclasses.replace(SMALL, train=tuple(dataclasses.replace(view, mask=is_odd) for view in SMALL.train))
    system = a2tg.Gaussians2dMcmc.preset("smoke", stage1_iterations=10, coarse_share=1.0, loss={"ssim_weight": 0.0})
    result = a2tg.fit(masked, system)
    assert result.history.psnr.tolist() == [np.inf] and result.history.loss.tolist() == [0]
    a2tg.save_checkpoint(tmp_path / "checkpoint.npz", result.checkpoint)
    assert a2tg.load_checkpoint(tmp_path / "checkpoint.npz").history.psnr.tolist() == [np.inf]


def test_halved_photographs():
    """Against sums of pixels in NumPy: over a background, as if each pixel were drawn over it before the mean."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (2, 7, 10, 3), np.uint8)
    alphas = rng.integers(0, 256, (2, 7, 10), np.uint8)
    alphas[0, :2, :2] = 0
    masks = rng.random((2, 7, 10)) < 0.8
    depths = np.where(rng.random((2, 7, 10)) < 0.9, rng.random((2, 7, 10)), np.nan).astype(np.float32)
    rays = rng.random((7, 10, 2)).astype(np.float32)
    Ks = np.asarray([[[8.0, 0, 5], [0, 9, 3.5], [0, 0, 1]]] * 2, np.float32)
    whole = Photographs(jnp.eye(4)[None].repeat(2, 0), *map(jnp.asarray, (Ks, images, alphas, masks, depths, rays)))
    half = jax.jit(Photographs.halved)(whole)

    def fours(x):
        return np.stack([x[:, i:6:2, k:10:2] for i in (0, 1) for k in (0, 1)])

    over = jax.vmap(lambda image, alpha: over_background(image, alpha, jnp.asarray([0.2, 0.5, 0.9])))
    drawn = np.asarray(over(whole.images, whole.alphas))
    np.testing.assert_allclose(over(half.images, half.alphas), fours(drawn).mean(0), atol=1e-6)
    np.testing.assert_array_equal(half.masks, fours(masks).all(0))
    np.testing.assert_array_equal(half.depths, fours(depths)[0])
    np.testing.assert_allclose(half.rays, fours(rays[None]).mean(0)[0] / 2, rtol=1e-6)
    np.testing.assert_allclose(half.Ks[0], [[4.0, 0, 2.5], [0, 4.5, 1.75], [0, 0, 1]])
    opaque = jax.jit(Photographs.halved)(whole._replace(alphas=None))
    np.testing.assert_allclose(opaque.images, fours(images.astype(np.float32)).mean(0), rtol=1e-6)
