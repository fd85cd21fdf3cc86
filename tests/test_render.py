"""Images of the renderer against the oracle, on random scenes with every kind of splat and texture size."""

import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from oracle import DEFAULT_RULES, OFFICIAL, Rules, Scene
from scenes_random import as_camera, as_gaussians, as_settings, as_textures, draw_scene, quick_then_long, render_scene

from a2tg_jax import RenderOutput, RenderSettings, render_image

FIELDS = ("color", "alpha", "depth", "normal")
OPTIONS = {
    "align-corners": Rules(uv="align-corners", sh_degree=2),
    "identity": Rules(outside="identity", near=1.0),
    "unit": Rules(rgb="unit", sh_degree=0),
    "global-maximum": Rules(alpha="global-maximum", max_alpha=0.9),
    "extent": Rules(outside="identity", extent=1.5),
    "all": OFFICIAL._replace(sh_degree=1, extent=0.7),
}
"""Each texture option alone, then all; the degree and the near plane change along, to compile less often."""


def errors(output: RenderOutput, expected: oracle.Image, is_compared: np.ndarray) -> dict[str, np.ndarray]:
    """Per field, the largest error over the channels at each compared pixel; depths relative where above 1."""
    found = {}
    for name in FIELDS:
        image = np.asarray(getattr(output, name))
        wanted = getattr(expected, name)
        assert image.shape == wanted.shape
        error = abs(image - wanted) / (np.maximum(wanted, 1) if name == "depth" else 1)
        found[name] = error.reshape(*wanted.shape[:2], -1).max(axis=-1)[is_compared]
    return found


def assert_equal_in_float64(scene: Scene, rules: Rules, output: RenderOutput):
    """All pixels agree to 1e-9; every scene here keeps its decisions farther than that from the thresholds."""
    expected = oracle.render(scene, rules)
    assert expected.margin.min() > 1e-9 and output.color.dtype == jnp.float64
    for name, error in errors(output, expected, np.full(expected.alpha.shape, True)).items():
        assert error.max() < 1e-9, name


SIZES = {f"{name}-{size}": dict(compositor=name, tile_size=size) for name in ("native", "xla") for size in (8, 16, 32)}
CASES = {
    **SIZES,
    # Tiles that fill no vector, and any number of tiles at once.
    **{f"native-{size}": dict(compositor="native", tile_size=size) for size in (3, 5)},
    **{f"xla-batches-{size}": dict(compositor="xla", tile_batch=size) for size in (0, 1, 5)},
}
QUICK = ["native-8", "native-5", "xla-8"]


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("case", quick_then_long(QUICK, sorted(CASES.keys() - QUICK)))
def test_float64(case):
    for seed in (0, 3, 4, 9) if case in SIZES else (4,):
        scene = draw_scene(seed)
        assert_equal_in_float64(scene, DEFAULT_RULES, render_scene(scene, "float64", as_settings(**CASES[case])))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("compositor", quick_then_long(["native"], ["xla"]))
@pytest.mark.parametrize("option", quick_then_long(["all"], [name for name in OPTIONS if name != "all"]))
def test_float64_options(option, compositor):
    scene = draw_scene(9)
    rules = OPTIONS[option]
    output = render_scene(scene, "float64", as_settings(rules, compositor=compositor))
    assert_equal_in_float64(scene, rules, output)


@pytest.mark.usefixtures("x64")
def test_official_preset_is_all_the_options():
    scene = draw_scene(5)
    assert_equal_in_float64(scene, OFFICIAL, render_scene(scene, "float64", RenderSettings.official()))


@pytest.mark.usefixtures("x64")
def test_without_textures_and_with_equal_depths_which_are_ordered_by_index():
    scene = draw_scene(3)
    scene = scene._replace(means=scene.means[np.arange(len(scene.means)) // 2 * 2])
    for each in (draw_scene(9)._replace(textures=None), scene):
        assert_equal_in_float64(each, DEFAULT_RULES, render_scene(each, "float64", as_settings(compositor="native")))


@pytest.mark.long
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("width", "height"), [(1, 1), (17, 33)])
def test_image_sizes(width, height):
    scene = draw_scene(2, num=20, width=width, height=height)
    assert_equal_in_float64(scene, DEFAULT_RULES, render_scene(scene, "float64", as_settings(tile_size=8)))


@pytest.mark.parametrize(("compositor", "tile_size"), quick_then_long([("native", 8)], [("native", 16), ("xla", 8)]))
def test_float32(compositor, tile_size):
    """99% of the pixels to 1e-5 and 99.9% to 3e-4, leaving out those that decide within 1e-4 of a threshold."""
    for seed in range(8):
        scene = draw_scene(seed)
        expected = oracle.render(scene)
        is_compared = expected.margin > 1e-4
        assert is_compared.mean() > 0.95
        output = render_scene(scene, "float32", as_settings(tile_size=tile_size, compositor=compositor))
        for name, error in errors(output, expected, is_compared).items():
            assert output.color.dtype == jnp.float32
            assert np.mean(error < 1e-5) >= 0.99 and np.mean(error < 3e-4) >= 0.999, (seed, name)


@pytest.mark.usefixtures("x64")
def test_an_eager_call_finds_its_own_capacity():
    scene = draw_scene(3, num=12)
    inputs = as_gaussians(scene, "float64"), as_camera(scene, "float64"), as_textures(scene, "float64")
    output = render_image(*inputs, background=scene.background.tolist())
    assert not output.overflow
    assert_equal_in_float64(scene, DEFAULT_RULES, output)


@pytest.mark.filterwarnings("ignore::a2tg_jax.EmptyRenderWarning")
def test_a_scene_wholly_behind_the_camera_is_background():
    scene = draw_scene(0)
    away = scene.viewmat.copy()
    away[2] = [0, 0, 0, -1]
    output = render_scene(scene._replace(viewmat=away), "float32", as_settings(compositor="native", tile_size=8))
    np.testing.assert_array_equal(output.alpha, 0)
    np.testing.assert_array_equal(output.color, np.broadcast_to(np.float32(scene.background), output.color.shape))
