"""Laws that any image obeys, and the contract of capacity, tracing and batching."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from oracle import Float, Scene
from scenes_random import as_camera, as_gaussians, as_settings, as_textures, draw_scene, quaternion, to_world

from a2tg_jax import (
    Camera,
    RenderOutput,
    RenderSettings,
    allocate_textures,
    plan_render,
    render_image,
)

FIELDS = ("color", "alpha", "depth", "normal")


def rendered(scene: Scene, settings: RenderSettings | None = None, dtype: str = "float64") -> RenderOutput:
    """The package's image of a scene, rendered eagerly."""
    textures, layout = as_textures(scene, dtype)
    return render_image(
        as_gaussians(scene, dtype),
        as_camera(scene, dtype),
        textures,
        layout,
        background=jnp.asarray(scene.background, dtype),
        settings=settings or RenderSettings(),
    )


def assert_same(one: RenderOutput, other: RenderOutput, tolerance: float = 1e-12):
    for name in FIELDS:
        np.testing.assert_allclose(
            getattr(one, name), getattr(other, name), rtol=tolerance, atol=tolerance, err_msg=name
        )


def rotation_of(seed: int) -> Float:
    """A random rotation [3, 3]."""
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return rotation * np.sign(np.linalg.det(rotation))


def rotate_sh(sh: Float, rotation: Float) -> Float:
    """Coefficients [N, 16, 3] whose colour seen along Q·d is that of the given ones along d, by least squares."""
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.array([oracle.sh_basis(direction) for direction in directions])
    after = np.array([oracle.sh_basis(rotation @ direction) for direction in directions])
    return np.linalg.lstsq(after, before, rcond=None)[0] @ sh


@pytest.mark.usefixtures("x64")
def test_initial_textures_are_no_textures():
    scene = draw_scene(1)
    textures, layout = allocate_textures(np.array([texture.shape[:2] for texture in scene.textures]))
    textures = jax.tree.map(lambda x: x.astype(jnp.float64), textures)
    background = jnp.asarray(scene.background)
    gaussians, camera = as_gaussians(scene, "float64"), as_camera(scene, "float64")
    textured = render_image(gaussians, camera, textures, layout, background=background)
    assert_same(textured, rendered(scene._replace(textures=None)))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("seed", [0, 1])
def test_a_constant_texture_of_any_size_is_its_one_texel(seed):
    scene = draw_scene(seed)
    single = [texture[:1, :1] for texture in scene.textures]
    constant = [np.broadcast_to(one, texture.shape) for one, texture in zip(single, scene.textures, strict=True)]
    assert_same(rendered(scene._replace(textures=constant)), rendered(scene._replace(textures=single)))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("seed", [0, 1])
def test_order_of_the_gaussians_does_not_matter(seed):
    scene = draw_scene(seed)
    order = np.random.default_rng(seed).permutation(len(scene.means))
    fields = ("means", "quats", "log_scales", "logit_opacities", "sh")
    permuted = {name: getattr(scene, name)[order] for name in fields}
    textures = [scene.textures[i] for i in order]
    assert_same(rendered(scene._replace(textures=textures, **permuted)), rendered(scene))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("seed", [0, 1])
def test_moving_world_and_camera_together(seed):
    scene, rotation = draw_scene(seed), rotation_of(seed + 10)
    inverse_motion = np.eye(4)
    inverse_motion[:3, :3] = rotation.T
    inverse_motion[:3, 3] = -rotation.T @ np.array([0.3, -2.0, 1.0])
    moved = [to_world(inverse_motion, mean, quat) for mean, quat in zip(scene.means, scene.quats, strict=True)]
    there = rendered(
        scene._replace(
            means=np.array([mean for mean, _ in moved]),
            quats=np.array([quat for _, quat in moved]),
            sh=rotate_sh(scene.sh, rotation),
            viewmat=scene.viewmat @ inverse_motion,
        )
    )
    assert_same(dataclasses.replace(there, normal=there.normal @ jnp.asarray(rotation)), rendered(scene), 1e-8)


@pytest.mark.usefixtures("x64")
def test_quaternions_need_no_unit_length_and_have_two_signs():
    scene = draw_scene(2)
    assert_same(rendered(scene._replace(quats=-3 * scene.quats)), rendered(scene), 1e-9)


@pytest.mark.usefixtures("x64")
def test_color_is_affine_in_rgb_texels():
    scene = draw_scene(4)
    rng = np.random.default_rng(0)
    other = [np.concatenate([rng.normal(size=(*t.shape[:2], 3)), t[..., 3:]], axis=-1) for t in scene.textures]
    mixed = [0.3 * a + 0.7 * b for a, b in zip(scene.textures, other, strict=True)]
    colors = [rendered(scene._replace(textures=textures)).color for textures in (scene.textures, other, mixed)]
    np.testing.assert_allclose(colors[2], 0.3 * colors[0] + 0.7 * colors[1], atol=1e-12)


@pytest.mark.parametrize("seed", [0, 4])
def test_tile_size_does_not_show(seed):
    """In float32 as well: a screen bound that is a fraction of a pixel short would show as a step of 1/255."""
    scene = draw_scene(seed, width=61, height=47)
    images = [rendered(scene, as_settings(tile_size=size), "float32") for size in (4, 8, 16, 64)]
    for image in images[1:]:
        assert_same(image, images[0], 2e-5)


@pytest.mark.usefixtures("x64")
def test_colors_mix_over_the_background():
    scene = draw_scene(6)
    black = rendered(scene._replace(background=np.zeros(3)))
    shown = rendered(scene)
    expected = black.color + (1 - black.alpha)[..., None] * jnp.asarray(scene.background)[None, None]
    np.testing.assert_allclose(shown.color, expected, atol=1e-12)
    np.testing.assert_array_equal(shown.depth, black.depth)
    np.testing.assert_array_equal(shown.normal, black.normal)


def test_the_same_shapes_are_traced_once():
    scene = draw_scene(0)
    textures, layout = as_textures(scene, "float32")
    gaussians, camera = as_gaussians(scene, "float32"), as_camera(scene, "float32")
    settings = plan_render(gaussians, [camera], textures, layout)
    num_traces = 0

    @jax.jit
    def draw(gaussians, camera, textures, layout):
        nonlocal num_traces
        num_traces += 1
        return render_image(gaussians, camera, textures, layout, settings=settings)

    for shift in (0.0, 0.01, 0.02):
        moved = dataclasses.replace(gaussians, means=gaussians.means + shift)
        draw(moved, camera, textures, layout)
    assert num_traces == 1


def test_one_layout_of_other_textures_is_not_traced_again():
    """Textures of the same sizes in another order have the same buckets: only values change."""
    scene = draw_scene(0)
    gaussians, camera = as_gaussians(scene, "float32"), as_camera(scene, "float32")
    num_traces = 0

    @jax.jit
    def draw(textures, layout):
        nonlocal num_traces
        num_traces += 1
        return render_image(gaussians, camera, textures, layout, settings=settings)

    settings = plan_render(gaussians, [camera], *as_textures(scene, "float32"))
    for textures in (scene.textures, scene.textures[::-1]):
        draw(*as_textures(scene._replace(textures=textures), "float32"))
    assert num_traces == 1


def test_a_missing_capacity_under_jit_says_what_to_do():
    scene = draw_scene(0)._replace(textures=None)
    with pytest.raises(ValueError, match="plan_render"):
        jax.jit(lambda gaussians: render_image(gaussians, as_camera(scene, "float32")).color)(
            as_gaussians(scene, "float32")
        )


@pytest.mark.parametrize("factor", [0.02, 0.3, 0.6, 1.0])
def test_too_small_a_capacity_is_flagged(factor):
    scene = draw_scene(0)
    textures, layout = as_textures(scene, "float32")
    gaussians, camera = as_gaussians(scene, "float32"), as_camera(scene, "float32")
    planned = plan_render(gaussians, [camera], textures, layout)
    settings = dataclasses.replace(planned, capacity=max(1, int(planned.capacity * factor)))
    output = jax.jit(lambda g: render_image(g, camera, textures, layout, settings=settings))(gaussians)
    if factor == 1.0:
        assert not output.overflow
    if factor == 0.02:
        assert output.overflow
    if not output.overflow:
        assert_same(output, render_image(gaussians, camera, textures, layout), 1e-5)


def test_a_plan_holds_for_all_its_cameras():
    scenes = [draw_scene(seed)._replace(textures=None) for seed in range(3)]
    gaussians = as_gaussians(scenes[0], "float32")
    cameras = [as_camera(scene, "float32") for scene in scenes]
    settings = plan_render(gaussians, cameras)
    draw = jax.jit(lambda camera: render_image(gaussians, camera, settings=settings))
    for camera in cameras:
        output = draw(camera)
        assert not output.overflow
        assert_same(output, render_image(gaussians, camera), 1e-5)


def test_cameras_can_be_batched():
    scene = draw_scene(2)
    textures, layout = as_textures(scene, "float32")
    gaussians, camera = as_gaussians(scene, "float32"), as_camera(scene, "float32")
    shifts = [np.zeros(3), np.array([0.1, 0, 0]), np.array([0, -0.2, 0.3])]
    viewmats = jnp.stack([camera.viewmat.at[:3, 3].add(jnp.asarray(shift, jnp.float32)) for shift in shifts])
    cameras = [Camera(viewmat, camera.K, camera.width, camera.height) for viewmat in viewmats]
    settings = plan_render(gaussians, cameras, textures, layout)

    def draw(viewmat):
        view = Camera(viewmat, camera.K, camera.width, camera.height)
        return render_image(gaussians, view, textures, layout, settings=settings)

    batched = jax.vmap(draw)(viewmats)
    for i, view in enumerate(cameras):
        one = jax.tree.map(lambda x, i=i: x[i], batched)
        assert_same(one, render_image(gaussians, view, textures, layout), 1e-5)


def test_quaternion_of_a_rotation():
    """The helper that moves worlds in these tests inverts the oracle's rotation."""
    rotation = rotation_of(3)
    np.testing.assert_allclose(oracle.rotation_matrix(quaternion(rotation)), rotation, atol=1e-12)
