"""Values in a console, a line each, and in a notebook, as pictures."""

import dataclasses
import io
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scenes_random import as_camera, as_gaussians, draw_scene
from small_models import some_checkpoint, some_model, with_row

import a2tg_jax as a2tg
from a2tg_jax import (
    A2tg,
    Appearance,
    Bands,
    Checkpoint,
    Evaluation,
    Exponents,
    FitResult,
    Geometry,
    History,
    Model,
    RenderOutput,
    Scene,
    StageResult,
    Texture,
    View,
    ViewMetrics,
    allocate_appearance,
)

CAMERA = as_camera(draw_scene(0, width=21, height=13), "float32")
MASK = np.arange(13 * 21).reshape(13, 21) % 2 == 0


def some_view(name: str = "a.png", channels: int = 3, mask: np.ndarray | None = None) -> View:
    pixels = np.random.default_rng(0).integers(0, 256, (13, 21, channels), dtype=np.uint8)
    return View(name, CAMERA, pixels, mask)


def some_scene(num: int = 12) -> Scene:
    views = tuple(some_view(f"<{index}>.png") for index in range(num))
    points = np.zeros((8412, 3), np.float32)
    return Scene("fox", views, (some_view("test.png"),), points, points, None, 1.0)


def small_model() -> Model:
    return Model(as_gaussians(draw_scene(1, num=5), "float32"))


def shown_by(template: Appearance) -> Model:
    gaussians = small_model().gaussians
    return Model(gaussians, allocate_appearance(template, jax.random.key(0), gaussians))


def some_history() -> History:
    first = with_row(History.empty(), 1, 100, 0.5, 20.0, 5, 0.1, 2.0)
    return with_row(first, 2, 1200, 0.4, 21.25, 5, 0.1, 9.0)


def fit_result() -> FitResult:
    stage = StageResult("texture", small_model(), some_history(), 12.4, 0)
    return FitResult(A2tg(), (stage, stage))


METRICS = tuple(ViewMetrics(f"{k}.png", 20.0 + k, 0.5, 0.25, 10.0) for k in range(3))
EVALUATION = Evaluation(METRICS, "vgg", 41.6, (np.zeros((50, 50, 3), np.uint8),) * 3)

LINES = {
    "Scene('fox', 12 training views, 1 test view, 21×13, 8,412 points)": some_scene,
    "View('a.png', 21×13)": some_view,
    "View('a.png', 21×13, with alpha, with a mask)": lambda: some_view(channels=4, mask=MASK),
    "Picture(uint8[13, 21, 3], in memory)": lambda: some_view().picture,
    "Evaluation(3 views, PSNR 21.00 dB, SSIM 0.500, LPIPS 0.250 (vgg), 42 frames/s)": lambda: EVALUATION,
    "Evaluation(0 views, 42 frames/s)": lambda: EVALUATION[:0],
    "Evaluation(3 views, PSNR 21.00 dB, SSIM 0.500, 42 frames/s)": lambda: dataclasses.replace(
        EVALUATION, lpips_network=None
    ),
    "Model(5 Gaussians, SH degree 3, plain Gaussians, 1.16 kB)": small_model,
    "Model(5 Gaussians, SH degree 3, Gaussians with exponents, 1.18 kB)": lambda: shown_by(
        Appearance(exponents=Exponents())
    ),
    "Model(5 Gaussians, SH degrees 3 to 3, Gaussians with texture, exponents and bands, 1.26 kB)": lambda: shown_by(
        Appearance(texture=Texture(), exponents=Exponents(), bands=Bands())
    ),
    "FitResult(A2tg, 2 stages, 5 Gaussians, 1.16 kB, 25 s)": fit_result,
    "StageResult('texture', 5 Gaussians, 1.16 kB, 12 s)": lambda: fit_result().stages[0],
    "History(2 rows to iteration 1,200 of stage 2, 21.25 dB)": some_history,
    "History(0 rows)": History.empty,
    "Checkpoint(A2tg, stage 2, iteration 1,200, 5 Gaussians)": lambda: Checkpoint(
        A2tg(), 1, types.SimpleNamespace(iteration=1200, model=small_model()), some_history()
    ),
    "Renderer(5 Gaussians, no size yet)": lambda: a2tg.Renderer(small_model()),
}


@pytest.mark.parametrize("line", LINES)
def test_a_value_is_a_line(line):
    assert repr(LINES[line]()) == line


def test_a_renderer_and_a_camera_print_their_size():
    renderer = a2tg.Renderer(small_model())
    renderer(CAMERA)
    assert repr(renderer) == "Renderer(5 Gaussians, 21×13)"
    camera = dataclasses.replace(CAMERA, width=np.int64(80))
    assert "width=80" in repr(camera) and type(camera.width) is int
    assert "OpenCV" in a2tg.Camera.__doc__ and "+0.5" in a2tg.Camera.__doc__


def test_model_without_values_has_a_repr():
    seen = []
    jax.jit(lambda model: seen.append(repr(model)) or model.gaussians.means)(small_model())
    model = dataclasses.replace(some_model(), num_live=jnp.int32(1))
    jax.jit(lambda model: seen.append(repr(model)) or model.gaussians.means)(model)
    assert seen[0].startswith("Model(5 Gaussians") and seen[1].startswith("Model(gaussians=Gaussians(")
    assert "object" in repr(jax.tree.map(lambda x: object(), model))


def decoded(file: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(file)))


def some_output(*views: int) -> RenderOutput:
    color = jnp.linspace(-0.5, 1.5, 13 * 21 * 3).reshape(13, 21, 3)
    plane = jnp.zeros((13, 21))
    output = RenderOutput(color, plane, jnp.asarray(False), Geometry(plane, jnp.zeros((13, 21, 3)), plane))
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (*views, *x.shape)), output)


def test_a_checkpoint_whose_buffers_are_reused_says_so():
    checkpoint = some_checkpoint(A2tg(sh_degree=0))
    model = checkpoint.state.model
    state = checkpoint.state
    assert repr(checkpoint) == "Checkpoint(A2tg, stage 2, iteration 0, 10 Gaussians)"
    model.num_live.delete()
    state.iteration.delete()
    assert repr(checkpoint) == "Checkpoint(A2tg, stage 2, its arrays reused by the next iteration)"
    assert repr(model).startswith("Model(gaussians=Gaussians(means=float32[")


def test_render_is_a_picture():
    output = some_output()
    assert repr(output).startswith("RenderOutput(color=float32[13, 21, 3], alpha=float32[13, 21], ")
    expected = np.rint(255 * np.clip(np.asarray(output.color), 0, 1))
    picture = decoded(output._repr_png_())
    np.testing.assert_array_equal(picture[::12, ::12], expected)
    assert picture.shape == (12 * 13, 12 * 21, 3), "small pictures are enlarged to 240 pixels"
    seen = []
    jax.jit(lambda output: seen.append(output._repr_png_()))(output)
    assert seen == [None] and some_output(2)._repr_png_() is None, "traced and several views have none"


def test_a_view_and_a_scene_are_pictures():
    view = some_view(channels=4)
    factor = -(-240 // view.picture.size[1])
    np.testing.assert_array_equal(decoded(view._repr_png_())[::factor, ::factor], view.picture.read())
    text = some_scene()._repr_html_()
    assert text.count("<img ") == 8 and "12 training views" in text
    assert 'title="&lt;0&gt;.png"' in text and 'title="&lt;11&gt;.png"' in text
    assert some_scene(2)._repr_html_().count("<img ") == 2


def test_model_is_a_short_table():
    text = some_model()._repr_html_()
    assert text.count("<tr>") <= 6 and "Gaussians" in text and "memory" in text


def test_every_public_class_has_a_docstring():
    """No helpers are public."""
    classes = [found for name in a2tg.__all__ if isinstance(found := getattr(a2tg, name), type)]
    assert all(isinstance(found.__doc__, str) for found in classes)
    assert not {"Any", "TYPE_CHECKING", "importlib"} & set(dir(a2tg)) and "__version__" in dir(a2tg)
