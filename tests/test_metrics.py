"""Metrics: clipping, LPIPS against the official package's figures, bytes by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from small_models import write_random_squeeze

from a2tg_jax import (
    Appearance,
    Model,
    Texture,
    allocate_textures,
    init_from_points,
    load_lpips,
    lpips,
    parameter_bytes,
    psnr,
    ssim,
)


def random_image(seed, shape=(24, 20, 3)):
    """Values on both sides of [0, 1]."""
    return np.random.default_rng(seed).uniform(-0.3, 1.3, shape)


def test_psnr_and_ssim_equal_scikit_image_on_clipped_images(x64):
    image = random_image(0)
    target = random_image(1)
    clipped = np.clip(image, 0, 1), np.clip(target, 0, 1)
    np.testing.assert_allclose(psnr(image, target), peak_signal_noise_ratio(*clipped, data_range=1), rtol=1e-12)
    wanted = structural_similarity(
        *clipped, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=-1
    )
    np.testing.assert_allclose(jax.jit(ssim)(image, target), wanted, atol=1e-12)


def test_equal_images_are_perfect_and_shapes_must_agree():
    image = jnp.asarray(random_image(0), jnp.float32)
    assert psnr(image, image) == np.inf
    np.testing.assert_allclose(jax.jit(ssim)(image, image), 1, atol=1e-6)
    with pytest.raises(ValueError, match="must both be"):
        psnr(jnp.zeros((4, 4, 3)), jnp.zeros((4, 5, 3)))


@pytest.mark.parametrize("network, distances", [("alex", (0.722, 0.138)), ("squeeze", (0.711, 0.148))])
def test_lpips_known_answers(shared, network, distances):
    weights = load_lpips(shared / "lpips" / f"lpips_{network}.npz")
    assert weights.network == network
    distance_of = jax.jit(lambda a, b: lpips(a, b, weights))
    reference, *others = (read_example(shared, name) for name in ("ex_ref", "ex_p0", "ex_p1"))
    for other, distance in zip(others, distances, strict=True):
        np.testing.assert_allclose(distance_of(reference, other), distance, atol=5e-4)


def read_example(shared, name):
    image = Image.open(shared / "lpips" / "example" / f"{name}.png").convert("RGB")
    return jnp.asarray(np.asarray(image), jnp.float32) / 255


@pytest.fixture(scope="module")
def random_squeeze(tmp_path_factory):
    return write_random_squeeze(tmp_path_factory.mktemp("weights") / "squeeze.npz")


def test_lpips_is_a_symmetric_distance_of_clipped_images(random_squeeze):
    image, target = (jnp.asarray(random_image(seed, (33, 40, 3)), jnp.float32) for seed in (0, 1))
    distance = jax.jit(lambda a, b: lpips(a, b, random_squeeze))
    between = distance(image, target)
    assert between.dtype == jnp.float32 and between > 0
    assert abs(distance(image, image)) < 1e-12  # fused multiply-adds round the two sides differently
    np.testing.assert_allclose(distance(target, image), between, rtol=1e-5)
    np.testing.assert_allclose(distance(jnp.clip(image, 0, 1), target), between, rtol=1e-5)


def test_weights_are_read_once(random_squeeze):
    assert load_lpips(str(random_squeeze)) is load_lpips(random_squeeze)


def test_wrong_weights_are_named(tmp_path, random_squeeze):
    with pytest.raises(FileNotFoundError, match=r"no LPIPS weights at .*absent\.npz"):
        load_lpips(tmp_path / "absent.npz")
    arrays = dict(np.load(random_squeeze))
    (tmp_path / "text.npz").write_text("not an archive")
    np.savez(tmp_path / "other.npz", means=np.zeros(3))
    np.savez(tmp_path / "mixed.npz", **arrays | {"lin3.weight": arrays["lin3.weight"][:, :5]})
    wrong = {
        "text": "is not an .npz archive",
        "other": "does not hold LPIPS weights",
        "mixed": "do not fit the channels",
    }
    for name, words in wrong.items():
        with pytest.raises(ValueError, match=f"{name}.*{words}"):
            load_lpips(tmp_path / f"{name}.npz")


def test_lpips_refuses_tiny_images(random_squeeze):
    with pytest.raises(ValueError, match="at least 32 pixels; got 40 by 31"):
        lpips(jnp.zeros((31, 40, 3)), jnp.zeros((31, 40, 3)), random_squeeze)


def test_bytes_are_counted_without_padding():
    rng = np.random.default_rng(0)
    gaussians = init_from_points(rng.normal(size=(100, 3)), rng.uniform(size=(100, 3)))
    sizes = np.ones((100, 2), int)
    sizes[:33] = (4, 2)
    textures = allocate_textures(sizes)
    assert parameter_bytes(gaussians) == 23_200
    assert parameter_bytes(gaussians, textures) == 23_200 + 16 * (67 + 33 * 8)
    allocated = sum(bucket.nbytes for bucket in textures.buckets)
    model = Model(gaussians, Appearance(texture=Texture(textures)))
    assert model.num_padding_bytes == allocated - 16 * (67 + 33 * 8)


def test_renders_may_exceed_one_in_places():
    target = np.full((16, 16, 3), 0.5, np.float32)
    bright = target.copy()
    bright[0, 0] = 50.0
    np.testing.assert_allclose(psnr(bright, target), -10 * np.log10(0.25 / 256), rtol=1e-5)
