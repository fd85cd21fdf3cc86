"""Masks: how they are found and read, and that what they exclude reaches neither training nor metrics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter
from skimage.metrics import structural_similarity
from test_data_colmap import HEIGHT, WIDTH, dot_place, write_scene
from test_data_transforms import FOCAL, SIZE, write_frames, write_json

from a2tg_jax import Gaussians2dMcmc, evaluate, fit, load_lpips, load_scene, lpips, polish, psnr, ssim, synthetic_scene
from a2tg_jax.data.photo_reading import read_mask
from a2tg_jax.training.start import initial_model

NAMES = tuple(f"img_{index:02d}.png" for index in range(9))


def write_mask(file, counts):
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(counts, 255, 0).astype(np.uint8)).save(file)


def left_half(width=WIDTH, height=HEIGHT):
    """A mask that keeps the left half."""
    return np.broadcast_to(np.arange(width) < width // 2, (height, width))


def views_of(scene):
    return (*scene.train, *scene.test)


@pytest.mark.parametrize("called", ["{name}.png", "{stem}.png"])
def test_masks_beside_the_images_of_colmap(tmp_path, called):
    write_scene(tmp_path)
    for name in NAMES:
        write_mask(tmp_path / "masks" / called.format(name=name, stem=name.removesuffix(".png")), left_half())
    for view in views_of(load_scene(tmp_path)):
        np.testing.assert_array_equal(view.mask.read(), left_half())
    for view in views_of(load_scene(tmp_path, downscale=4)):
        np.testing.assert_array_equal(view.mask.read()[:, :15], True)
        np.testing.assert_array_equal(view.mask.read()[:, 17:], False)


def test_masks_at_the_size_of_smaller_images(tmp_path):
    write_scene(tmp_path)
    for name in NAMES:
        for folder in ("images_2", "masks_2"):
            (tmp_path / folder).mkdir(exist_ok=True)
        Image.open(tmp_path / "images" / name).resize((WIDTH // 2, HEIGHT // 2)).save(tmp_path / "images_2" / name)
        write_mask(tmp_path / "masks_2" / name, left_half(WIDTH // 2, HEIGHT // 2))
    for view in views_of(load_scene(tmp_path, downscale=2)):
        np.testing.assert_array_equal(view.mask.read(), left_half(WIDTH // 2, HEIGHT // 2))


def test_a_mask_is_undistorted_with_its_photograph(tmp_path):
    """A mask that keeps the dot alone keeps it where the undistorted photograph shows it."""
    write_scene(tmp_path, models=("OPENCV_FISHEYE",), num_views=4)
    for name in NAMES[:4]:
        photograph = np.asarray(Image.open(tmp_path / "images" / name))
        write_mask(tmp_path / "masks" / name, photograph[..., 0] > 20)
    for view in views_of(load_scene(tmp_path)):
        assert 0 < view.mask.num < 120
        np.testing.assert_allclose(
            dot_place(np.repeat(view.mask.read()[..., None], 3, 2)), dot_place(view.image), atol=0.7
        )


def rgba(colors, alpha):
    return np.dstack([np.broadcast_to(colors, (HEIGHT, WIDTH, 3)), alpha]).astype(np.uint8)


HALF_ALPHA = np.where(np.arange(WIDTH) < WIDTH // 2, 255, 0) * np.ones((HEIGHT, 1))
TOP_LIT = np.where(np.arange(HEIGHT) < 30, 255, 0)[:, None, None] * np.ones((1, WIDTH, 3))
CUT_OUT = np.random.default_rng(0).integers(0, 2, (HEIGHT, WIDTH, 3)) * 255


@pytest.mark.parametrize(
    ("pixels", "top_only"),
    [
        (rgba(255, HALF_ALPHA), False),
        (rgba(0, HALF_ALPHA), False),
        (rgba(CUT_OUT, HALF_ALPHA), False),
        (rgba(TOP_LIT, HALF_ALPHA), True),
        (rgba(255, HALF_ALPHA)[..., [0, 3]], False),
    ],
    ids=["white", "black", "cut-out", "both", "grey"],
)
def test_a_mask_in_an_alpha_channel(tmp_path, pixels, top_only):
    write_scene(tmp_path)
    (tmp_path / "masks").mkdir()
    for name in NAMES:
        Image.fromarray(pixels).save(tmp_path / "masks" / name)
    wanted = left_half() & (np.arange(HEIGHT) < (30 if top_only else HEIGHT))[:, None]
    for view in views_of(load_scene(tmp_path)):
        np.testing.assert_array_equal(view.mask.read(), wanted)


SPOTS = gaussian_filter(np.random.default_rng(0).normal(size=(HEIGHT, WIDTH)), 4) > 0
"""A mask of many edges."""


def in_alpha(levels):
    return np.dstack([np.full((HEIGHT, WIDTH, 3), 255), levels])


LEVELS = {
    "0 1": (0, 1), "0 3": (0, 3), "0 16": (0, 16), "0 200": (0, 200), "0 255": (0, 255), "3 255": (3, 255),
    "16 235": (16, 235), "16 255": (16, 255), "red": ((0, 0, 0), (255, 0, 0)),
    "nearly black": ((3, 16, 9), (250, 251, 9)),
}  # fmt: skip
"""Levels or colours of excluded and of kept pixels."""


@pytest.mark.parametrize("kind", ["png", "alpha", "jpg 95", "jpg 50", "blurred"])
@pytest.mark.parametrize("name", LEVELS)
def test_black_may_be_dark_or_noisy(tmp_path, name, kind):
    """Of levels 0 to 16 that JPEG leaves around edges, too few are left to tell."""
    levels = np.where(SPOTS.reshape(HEIGHT, WIDTH, *[1] * np.ndim(LEVELS[name][0])), *LEVELS[name][::-1]).astype(
        np.uint8
    )
    if (kind == "alpha" and levels.ndim == 3) or (kind[0] in "bj" and levels.max() < 64):
        pytest.skip("no such mask")
    levels = in_alpha(levels) if kind == "alpha" else levels
    levels = gaussian_filter(levels.astype(float), (1, 1, 0)[: levels.ndim]) if kind == "blurred" else levels
    file = tmp_path / ("mask.jpg" if kind[0] == "j" else "mask.png")
    options = {"quality": int(kind[-2:])} if kind[0] == "j" else {}
    Image.fromarray(levels.astype(np.uint8)).save(file, **options)
    mask = read_mask(file, (WIDTH, HEIGHT))
    assert (mask.counts != SPOTS).mean() <= (0.02 if kind == "blurred" else 0.005 if kind[0] == "j" else 0)
    assert not mask.has_grey_areas


CLASSES = np.add.outer(np.arange(HEIGHT) // 12, np.arange(WIDTH) // 16)
"""Numbers of classes, 0 to 14, in areas."""


@pytest.mark.parametrize(
    ("levels", "counts", "is_told"),
    [
        (CLASSES, CLASSES > 0, False),
        (CLASSES * (CLASSES < 2) + 16 * (CLASSES == 2), (CLASSES == 1) | (CLASSES == 2), False),
        (17 * CLASSES + (CLASSES > 0), CLASSES > 1, True),
        (np.where(SPOTS, 255, 120 * left_half()), SPOTS | left_half(), True),
        (CLASSES + 1, CLASSES > -1, True),
        (np.full_like(CLASSES, 1), CLASSES > -1, False),
        (np.full_like(CLASSES, 255), CLASSES > -1, False),
        (np.full_like(CLASSES, 16), CLASSES > -1, True),
        (np.zeros_like(CLASSES), CLASSES < 0, False),
    ],
    ids=["classes", "dark classes", "light classes", "grey", "classes from 1", "all 1", "all 255", "all 16", "none"],
)  # fmt: skip
def test_masks_of_several_levels(tmp_path, levels, counts, is_told):
    Image.fromarray(levels.astype(np.uint8)).save(tmp_path / "mask.png")
    mask = read_mask(tmp_path / "mask.png", (WIDTH, HEIGHT))
    np.testing.assert_array_equal(mask.counts, counts)
    assert mask.has_grey_areas == is_told


@pytest.mark.parametrize("mask_as", ["ignored", "background"])
def test_masks_that_are_neither_black_nor_white_are_named(tmp_path, mask_as):
    write_scene(tmp_path)
    for index, name in enumerate(NAMES):
        (tmp_path / "masks").mkdir(exist_ok=True)
        levels = np.where(left_half(), 255, 100 if index in (2, 5) else 0).astype(np.uint8)
        Image.fromarray(levels).save(tmp_path / "masks" / name)
    with pytest.warns(UserWarning, match=r"masks: 2 of 9 masks have areas .* white, such as img_02\.png: pixels above"):
        load_scene(tmp_path, mask_as=mask_as)


@pytest.mark.parametrize("folder", ["mask", "Masks", "object_mask"])
def test_masks_in_a_folder_of_another_name_are_noticed(tmp_path, folder):
    write_scene(tmp_path)
    write_mask(tmp_path / folder / NAMES[3], left_half())
    with pytest.warns(UserWarning, match=f"{folder}: not read; if it holds masks, rename it to masks"):
        load_scene(tmp_path)


def test_what_is_wrong_with_masks(tmp_path):
    write_scene(tmp_path)
    write_mask(tmp_path / "masks" / "other.png", left_half())
    with pytest.warns(UserWarning, match="masks: holds no mask of a photograph of the scene"):
        load_scene(tmp_path)
    write_mask(tmp_path / "masks" / NAMES[3], left_half())
    with pytest.warns(UserWarning, match="8 of 9 photographs have no mask, such as img_00.png"):
        load_scene(tmp_path)
    write_mask(tmp_path / "masks" / NAMES[3], left_half(WIDTH, HEIGHT + 1))
    with pytest.raises(ValueError, match=r"img_03.png: is 128x97, but its photograph is 128x96"):
        load_scene(tmp_path)
    for name in NAMES:
        write_mask(tmp_path / "masks" / name, np.zeros((HEIGHT, WIDTH), bool))
    with pytest.raises(ValueError, match=r"the mask of img_00.png excludes every pixel"):
        load_scene(tmp_path)


def test_mask_path_of_nerfstudio(tmp_path):
    frames = write_frames(tmp_path)
    for index, frame in enumerate(frames):
        frame["mask_path"] = f"held/{index}.png"
        write_mask(tmp_path / "held" / f"{index}.png", left_half(SIZE["w"], SIZE["h"]))
    write_json(tmp_path, frames, **FOCAL, **SIZE)
    with pytest.warns(UserWarning, match="sparse points"):
        views = views_of(load_scene(tmp_path))
    for view in views:
        np.testing.assert_array_equal(view.mask.read(), left_half(SIZE["w"], SIZE["h"]))
    (tmp_path / "held" / "3.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"3.png: no such mask, but the scene names it"):
        load_scene(tmp_path)


def test_alpha_is_transparency_or_a_mask(tmp_path):
    frames = write_frames(tmp_path, alpha=True)
    for frame in frames:
        pixels = np.array(Image.open(tmp_path / frame["file_path"]))
        pixels[..., 3] = np.minimum(2 * pixels[..., 3].astype(int), 255)
        Image.fromarray(pixels).save(tmp_path / frame["file_path"])
    write_json(tmp_path, frames, **FOCAL, **SIZE)
    with pytest.warns(UserWarning, match="sparse points"):
        transparent = load_scene(tmp_path)
        masked = load_scene(tmp_path, alpha="mask")
    for before, after in zip(views_of(transparent), views_of(masked), strict=True):
        assert before.mask is None and not after.has_alpha
        np.testing.assert_array_equal(after.mask.read(), before.alpha == 255)
        assert 0 < after.mask.num < 200
        np.testing.assert_array_equal(after.image, before.image)
    with pytest.raises(ValueError, match="alpha must be one of transparency, mask; got 'cut'"):
        load_scene(tmp_path, alpha="cut")


@pytest.mark.parametrize("room", [None, 0], ids=["held", "on disk"])
@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV_FISHEYE"])
def test_a_mask_as_background_is_an_alpha_channel(tmp_path, model, room):
    """Photographs with masks are as the same ones with the mask in their alpha channel, or multiplied into it."""
    rng = np.random.default_rng(0)
    for folder in ("masks", "alpha"):
        write_scene(tmp_path / folder, models=(model,))
    for index, name in enumerate(NAMES):
        photograph = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
        alpha = rng.integers(1, 256, (HEIGHT, WIDTH), np.uint8) if index == 4 else np.full((HEIGHT, WIDTH), 255)
        counts = rng.random((HEIGHT // 8, WIDTH // 8)).repeat(8, 0).repeat(8, 1) < (0.5 if index else 2.0)
        whole = np.dstack([photograph, alpha]).astype(np.uint8)
        Image.fromarray(whole).save(tmp_path / "masks" / "images" / name)
        Image.fromarray(np.where(counts[..., None], whole, whole * [1, 1, 1, 0]).astype(np.uint8)).save(
            tmp_path / "alpha" / "images" / name
        )
        write_mask(tmp_path / "masks" / "masks" / name, counts)
    for downscale in (1, 2):
        options = {"downscale": downscale, "room": room}
        views = views_of(load_scene(tmp_path / "masks", mask_as="background", **options))
        for own, other in zip(views, views_of(load_scene(tmp_path / "alpha", **options)), strict=True):
            assert own.mask is None and own.has_alpha == other.has_alpha == (own.name != NAMES[0])
            for _ in range(2):
                np.testing.assert_array_equal(own.picture.read(), other.picture.read())


def test_a_mask_as_background_has_one_meaning(tmp_path):
    write_scene(tmp_path)
    with pytest.warns(
        UserWarning, match="no photograph has a mask, so that `mask_as` background changes nothing; masks"
    ):
        load_scene(tmp_path, mask_as="background")
    with pytest.raises(ValueError, match="`alpha` must be transparency where `mask_as` is background"):
        load_scene(tmp_path, alpha="mask", mask_as="background")
    with pytest.raises(ValueError, match="mask_as must be one of ignored, background; got 'cut'"):
        load_scene(tmp_path, mask_as="cut")


@pytest.fixture(scope="module")
def masked():
    """A scene with a different mask for each training view but one, and the same with noise where they exclude."""
    scene = synthetic_scene(num_views=6, width=40, height=30, num_points=150)
    rng = np.random.default_rng(0)

    def with_mask(view):
        mask = np.ones(view.picture.size, bool)
        left = rng.integers(0, 20)
        top = rng.integers(0, 15)
        mask[top : top + 12, left : left + 14] = False
        return dataclasses.replace(view, mask=mask)

    def with_noise(view):
        noise = rng.integers(0, 256, view.image.shape, np.uint8)
        return dataclasses.replace(view, picture=np.where(view.mask.read()[..., None], view.image, noise))

    train = tuple(map(with_mask, scene.train[:-1]))
    clean = dataclasses.replace(scene, train=(*train, scene.train[-1]))
    return clean, dataclasses.replace(scene, train=(*map(with_noise, train), scene.train[-1]))


@pytest.mark.long
def test_masked_pixels_do_not_reach_training(masked):
    system = Gaussians2dMcmc(stage1_iterations=24, initial_gaussians=60, batch_size=2)
    clean, noisy = (fit(scene, system) for scene in masked)
    jax.tree.map(np.testing.assert_array_equal, clean.model.gaussians, noisy.model.gaussians)
    np.testing.assert_array_equal(clean.history.psnr, noisy.history.psnr)
    polished = [polish(clean.model, scene.train, num_steps=2).gaussians.sh for scene in masked]
    np.testing.assert_array_equal(*polished)
    assert np.abs(polished[0] - clean.model.gaussians.sh).max() > 1e-3
    first, second = (evaluate(scene.train, clean.model).per_view for scene in masked)
    assert first == second


def test_a_view_counts_by_its_pixels(masked):
    """The PSNR of a step counts only the pixels of the mask."""
    scene = dataclasses.replace(masked[0], train=masked[0].train[:1])
    system = Gaussians2dMcmc(stage1_iterations=1, initial_gaussians=60)
    start = initial_model(scene, system)
    logged = fit(scene, system).history.psnr[0]
    image = np.asarray(start.render(scene.train[0].camera).color)
    view = scene.train[0]
    error = (np.clip(image, 0, 1) - view.image / 255.0)[view.mask.read()]
    np.testing.assert_allclose(logged, -10 * np.log10(np.mean(error**2)), atol=1e-4)


def oracle_ssim(image, target, mask):
    """The mean over the windows that touch a pixel that counts, from scikit-image's map."""
    black = np.where(mask[..., None], image, 0), np.where(mask[..., None], target, 0)
    _, similarity = structural_similarity(
        *black, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=-1, full=True
    )
    windows = np.lib.stride_tricks.sliding_window_view(mask, (11, 11)).any(axis=(2, 3))
    return similarity[5:-5, 5:-5][windows].mean()


@pytest.mark.parametrize("seed", [0, 1])
def test_metrics_of_the_pixels_that_count(x64, seed):
    rng = np.random.default_rng(seed)
    image, target = rng.uniform(0, 1, (2, 40, 36, 3))
    mask = rng.uniform(0, 1, (40, 36)) < 0.9
    mask[8:, 4:30] = False
    error = (image - target)[mask]
    np.testing.assert_allclose(psnr(image, target, mask), -10 * np.log10(np.mean(error**2)), rtol=1e-12)
    np.testing.assert_allclose(ssim(image, target, mask), oracle_ssim(image, target, mask), rtol=1e-9)
    everywhere = np.ones_like(mask)
    for metric in (psnr, ssim):
        np.testing.assert_allclose(metric(image, target, everywhere), metric(image, target), rtol=1e-12)


@pytest.mark.long
def test_lpips_does_not_depend_on_masked_pixels(shared):
    weights = load_lpips(shared / "lpips" / "lpips_squeeze.npz")
    rng = np.random.default_rng(0)
    image, target = jnp.asarray(rng.uniform(0, 1, (2, 48, 48, 3)), jnp.float32)
    mask = np.zeros((48, 48), bool)
    mask[10:30, 10:30] = True
    other = jnp.where(mask[..., None], image, target)
    assert lpips(image, target, weights, mask) == lpips(other, target, weights, mask)
    assert 0 < lpips(image, target, weights, mask) < lpips(image, target, weights)
