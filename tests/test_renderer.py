"""Cameras that move: few compilations, no camera refused, the image that `render_image` makes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_programs import compiled_programs
from scenes_random import as_camera, as_gaussians, draw_scene

import a2tg_jax as a2tg
from a2tg_jax import Camera, Gaussians, View, resize_camera
from a2tg_jax.render import jitted_render
from a2tg_jax.results.frames import frame_size, widen_camera


def cloud(num: int = 300) -> Gaussians:
    """Small splats in a ball about the origin."""
    rng = np.random.default_rng(0)
    draw = lambda *shape: jnp.asarray(rng.normal(size=shape), jnp.float32)  # noqa: E731
    return Gaussians(0.4 * draw(num, 3), draw(num, 4), 0.3 * draw(num, 2) - 2, draw(num), 0.2 * draw(num, 16, 3))


def flight(num: int, size: tuple[int, int] = (48, 32)) -> list[Camera]:
    """Cameras that first look away from the ball, then move back through it, until it is small and far away."""
    width, height = size
    K = jnp.array([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    return [Camera(jnp.eye(4).at[2, 3].set(float(z)), K, width, height) for z in np.linspace(-3, 60, num)]


@pytest.mark.filterwarnings("ignore::a2tg_jax.EmptyRenderWarning")
def test_a_flight_of_200_views_compiles_three_times_at_most():
    gaussians = cloud(2000)
    renderer = a2tg.Renderer(gaussians, has_geometry=False)
    pairs = [a2tg.plan_render(gaussians, camera).capacity for camera in flight(20)]
    assert max(pairs) > 4 * pairs[0], "the flight is to need more room on its way"
    with compiled_programs("render_traced") as programs:
        frames = [(camera, renderer(camera)) for camera in flight(200)]
    assert not any(output.overflow for _, output in frames)
    assert 2 <= len(programs) <= 3
    for camera, output in frames[39::40]:
        np.testing.assert_array_equal(output.color, a2tg.render_image(gaussians, camera).color)


@pytest.mark.parametrize("are_given", [True, False])
def test_cameras_that_are_known_compile_once(are_given):
    """They are given, or the model was trained with them."""
    gaussians = cloud(2100 if are_given else 2200)
    cameras = flight(10, (40, 24))
    model = (
        a2tg.Model(gaussians)
        if are_given
        else a2tg.Model(gaussians, origin=a2tg.Origin.of_cameras(flight(10, (20, 12))))
    )
    renderer = a2tg.Renderer(model, cameras=cameras if are_given else (), has_geometry=False)
    with compiled_programs("render_traced") as programs:
        for camera in cameras:
            renderer(camera)
    assert len(programs) == 1


def test_several_sizes_and_models_of_one_shape():
    cameras = [resize_camera(camera, *size) for camera in flight(4)[:3] for size in ((24, 16), (16, 24))]
    jitted_render().clear_cache()
    with compiled_programs("render_traced") as programs:
        for shift in (0.0, 0.1):
            gaussians = dataclasses.replace(cloud(), means=cloud().means + shift)
            renderer = a2tg.Renderer(gaussians, cameras=cameras, has_geometry=False)
            for camera in cameras:
                assert renderer(camera).color.shape == (camera.height, camera.width, 3)
            assert set(renderer.capacities) == {(24, 16), (16, 24)}
    assert len(programs) == 2


def test_a_model_with_all_that_belongs_to_it():
    scene = draw_scene(4)
    camera = as_camera(scene, "float32")
    textures = a2tg.textures_from_arrays([np.asarray(texture, np.float32) for texture in scene.textures])
    background = tuple(scene.background.tolist())
    model = a2tg.Model(
        as_gaussians(scene, "float32"),
        a2tg.Appearance(texture=a2tg.Texture(textures)),
        jnp.asarray(45),
        background=background,
        origin=a2tg.Origin.of_cameras([camera]),
    )
    found = a2tg.Renderer(model)(camera)
    expected = model.live.render(camera)
    for image, wanted in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_array_equal(image, wanted)
    assert expected.depth.max() > 0


def test_what_a_renderer_refuses():
    camera = flight(1)[0]
    textures = a2tg.textures_from_arrays(np.ones((300, 1, 1, 4)))
    for call, words in (
        (lambda: a2tg.Renderer(a2tg.Model(cloud()), a2tg.Appearance()), "appearance: a model has its own"),
        (lambda: a2tg.Renderer(cloud(), background=(0, 0, 0, 1)), r"background must be \[3\]; got \[4\]"),
        (
            lambda: a2tg.Renderer(cloud())(dataclasses.replace(camera, K=jnp.eye(4))),
            r"camera\.K must be \[3, 3\]; got \[4, 4\]",
        ),
        (lambda: a2tg.plan_render(cloud(), camera, head_room=0.5), "head_room must be at least 1"),
        (lambda: a2tg.plan_render(cloud(), []), "cameras must be one camera at least"),
        (
            lambda: a2tg.plan_render(cloud(), camera, textures, appearance=a2tg.Appearance()),
            "an appearance or textures, not both",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            call()


def test_gaussians_alone_are_as_opaque_as_the_settings_let_them_be():
    """As `render_image` has it: 0.999 in the authors' conventions, else 0.99."""
    camera = flight(9)[1]
    settings = a2tg.RenderSettings.official()
    gaussians = dataclasses.replace(cloud(), logit_opacities=jnp.full(300, 9.0))
    expected = a2tg.render_image(gaussians, camera, settings=settings)
    assert 1 - expected.alpha.max() < 2e-3
    np.testing.assert_array_equal(a2tg.Renderer(gaussians, settings=settings)(camera).alpha, expected.alpha)
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    found = a2tg.evaluate([View("view", camera, image)], gaussians, settings=settings, num_renders=1)
    wanted = np.rint(255 * np.clip(np.asarray(expected.color), 0, 1))
    assert np.abs(found.renders[0].astype(int) - wanted).max() <= 1
    opaque = a2tg.render_image(gaussians, camera).color
    assert np.abs(np.rint(255 * np.clip(np.asarray(opaque), 0, 1)) - wanted).max() > 1


def test_plan_with_an_appearance_and_head_room():
    camera = flight(3)[1]
    appearance = a2tg.Appearance()
    assert a2tg.plan_render(cloud(), camera, appearance=appearance) == a2tg.plan_render(cloud(), camera)
    roomy = a2tg.plan_render(cloud(3000), camera, appearance=appearance, head_room=10)
    assert roomy.capacity > 4 * a2tg.plan_render(cloud(3000), camera, appearance=appearance).capacity


@pytest.mark.parametrize(("width", "height", "factor"), [(96, 96, 2), (96, 16, 0.5), (24, 16, 0.5), (20, 64, 5 / 12)])
def test_a_view_of_another_aspect_is_whole_and_keeps_its_centre_and_proportions(width, height, factor):
    K = np.array([[30.0, 0, 25], [0, 28.0, 14], [0, 0, 1]], np.float32)
    camera = widen_camera(Camera(jnp.eye(4), jnp.asarray(K), 48, 32), width, height)
    assert (camera.width, camera.height) == (width, height)
    expected = factor * K[:2] + [[0, 0, (width - factor * 48) / 2], [0, 0, (height - factor * 32) / 2]]
    # Widened views have whole pixels, here up to 0.35 more or less of 20.
    np.testing.assert_allclose(camera.K[:2], expected, rtol=0.04)


@pytest.mark.parametrize(
    ("photograph", "frame"),
    [((640, 480), (1108, 832)), ((480, 640), (832, 1108)), ((3840, 2160), (1280, 720)), ((9, 9), (960, 960))],
)
def test_frames_have_the_aspect_of_the_photographs_and_an_even_size(photograph, frame):
    assert frame_size(Camera(jnp.eye(4), jnp.eye(3), *photograph)) == frame


def test_room_is_planned_within_a_gradient():
    gaussians, (_, camera) = cloud(40), flight(2)
    planned = a2tg.plan_render(gaussians, camera).capacity

    def loss(means, viewmat):
        moved = dataclasses.replace(gaussians, means=means), dataclasses.replace(camera, viewmat=viewmat)
        assert a2tg.plan_render(*moved).capacity == planned
        return jnp.sum(means)

    np.testing.assert_array_equal(jax.grad(loss)(gaussians.means, camera.viewmat), np.ones((40, 3)))
    jax.grad(loss, argnums=1)(gaussians.means, camera.viewmat)
