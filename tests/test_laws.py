"""Laws that any image obeys, and the contract of capacity, tracing and batching."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from oracle import Float, Scene
from scenes_random import (
    as_camera,
    as_gaussians,
    as_settings,
    as_textures,
    draw_scene,
    jitted_renderer,
    quaternion,
    render_scene,
    to_world,
)

import a2tg_jax as a2tg

FIELDS = ("color", "alpha", "depth", "normal")
rendered = functools.partial(render_scene, dtype="float64")
x64 = pytest.mark.usefixtures("x64")


def assert_same(one: a2tg.RenderOutput, other: a2tg.RenderOutput, tolerance: float = 1e-12):
    for name in FIELDS:
        np.testing.assert_allclose(
            getattr(one, name), getattr(other, name), rtol=tolerance, atol=tolerance, err_msg=name
        )


def rotation_of(seed: int) -> Float:
    """A random rotation [3, 3]."""
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return rotation * np.sign(np.linalg.det(rotation))


def rotate_sh(sh: Float, rotation: Float) -> Float:
    """Coefficients [N, 16, 3] whose colour seen along Q·d equals the given ones' along d, by least squares."""
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.array([oracle.sh_basis(direction) for direction in directions])
    after = np.array([oracle.sh_basis(rotation @ direction) for direction in directions])
    return np.linalg.lstsq(after, before, rcond=None)[0] @ sh


@x64
def test_textures_that_change_nothing():
    """Initial ones are none, a constant one of any size is its one texel, and colour is affine in RGB texels."""
    scene = draw_scene(1)
    rng = np.random.default_rng(0)
    textures = a2tg.allocate_textures(np.array([texture.shape[:2] for texture in scene.textures]))
    neutral = [np.asarray(texture) for texture in a2tg.texture_arrays(textures)]
    assert_same(rendered(scene._replace(textures=neutral)), rendered(scene._replace(textures=None)))
    single = [texture[:1, :1] for texture in scene.textures]
    constant = [np.broadcast_to(one, texture.shape) for one, texture in zip(single, scene.textures, strict=True)]
    assert_same(rendered(scene._replace(textures=constant)), rendered(scene._replace(textures=single)))
    other = [np.concatenate([rng.normal(size=(*t.shape[:2], 3)), t[..., 3:]], axis=-1) for t in scene.textures]
    mixed = [0.3 * a + 0.7 * b for a, b in zip(scene.textures, other, strict=True)]
    colors = [rendered(scene._replace(textures=textures)).color for textures in (scene.textures, other, mixed)]
    np.testing.assert_allclose(colors[2], 0.3 * colors[0] + 0.7 * colors[1], atol=1e-12)


@x64
@pytest.mark.parametrize("seed", [0, 1])
def test_order_of_the_gaussians_and_scale_and_sign_of_quaternions_do_not_matter(seed):
    scene = draw_scene(seed)
    order = np.random.default_rng(seed).permutation(len(scene.means))
    fields = ("means", "quats", "log_scales", "logit_opacities", "sh")
    permuted = {name: getattr(scene, name)[order] for name in fields}
    textures = [scene.textures[i] for i in order]
    assert_same(rendered(scene._replace(textures=textures, **permuted)), rendered(scene))
    assert_same(rendered(scene._replace(quats=-3 * scene.quats)), rendered(scene), 1e-9)


@x64
@pytest.mark.parametrize("seed", [0, 1])
def test_moving_world_and_camera_together(seed):
    scene = draw_scene(seed)
    rotation = rotation_of(seed + 10)
    # The helper that moves worlds inverts the oracle's rotation.
    np.testing.assert_allclose(oracle.rotation_matrix(quaternion(rotation)), rotation, atol=1e-12)
    # The camera centre −Rcᵀt moves along only where Rc is a rotation to more digits than float32 has.
    left, _, right = np.linalg.svd(scene.viewmat[:3, :3])
    scene.viewmat[:3, :3] = left @ right
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
    turned = dataclasses.replace(there.geometry, normal=there.normal @ jnp.asarray(rotation))
    assert_same(dataclasses.replace(there, geometry=turned), rendered(scene), 1e-8)


@pytest.mark.long
def test_tile_size_does_not_show():
    """In float32 as well, up to rounding on splats seen edge-on: a short screen bound would show as a step of 1/255."""
    for seed in (0, 4):
        images = [render_scene(draw_scene(seed), "float32", as_settings(tile_size=size)) for size in (8, 16, 64)]
        for image in images[1:]:
            assert_same(image, images[0], 3e-4)


@x64
def test_colors_mix_over_the_background():
    scene = draw_scene(6)
    black = rendered(scene._replace(background=np.zeros(3)))
    shown = rendered(scene)
    expected = black.color + (1 - black.alpha)[..., None] * jnp.asarray(scene.background)[None, None]
    np.testing.assert_allclose(shown.color, expected, atol=1e-12)
    np.testing.assert_array_equal(shown.depth, black.depth)
    np.testing.assert_array_equal(shown.normal, black.normal)


def inputs_of(scene: Scene):
    return as_gaussians(scene, "float32"), as_camera(scene, "float32"), as_textures(scene, "float32")


def test_the_same_shapes_are_traced_once():
    """Other values are not traced again, nor are textures of the same sizes in another order: the buckets are alike."""
    scene = draw_scene(0)
    gaussians, camera, textures = inputs_of(scene)
    settings = a2tg.plan_render(gaussians, [camera], textures)
    num_traces = 0

    @jax.jit
    def draw(gaussians, camera, textures):
        nonlocal num_traces
        num_traces += 1
        return a2tg.render_image(gaussians, camera, textures, settings=settings)

    for shift, textures in [(0.0, scene.textures), (0.01, scene.textures), (0.02, scene.textures[::-1])]:
        moved = dataclasses.replace(gaussians, means=gaussians.means + shift)
        draw(moved, camera, as_textures(scene._replace(textures=textures), "float32"))
    assert num_traces == 1


@pytest.mark.parametrize("transform", [jax.jit, lambda draw: lambda x: jax.vmap(draw)(x[None])], ids=["jit", "vmap"])
def test_a_missing_capacity_says_what_to_do(transform):
    gaussians, camera, _ = inputs_of(draw_scene(0))

    def draw(means):
        return a2tg.render_image(dataclasses.replace(gaussians, means=means), camera).color

    with pytest.raises(ValueError, match="plan_render"):
        transform(draw)(gaussians.means)


def draw_with(settings: a2tg.RenderSettings, scene: Scene) -> a2tg.RenderOutput:
    """The float32 image under given settings, capacity included, under jit."""
    return jitted_renderer(settings)(*inputs_of(scene), jnp.asarray(scene.background, jnp.float32))


def test_too_small_a_capacity_is_flagged_and_a_plan_holds_for_all_its_cameras():
    """Either the flag is up or the image is whole."""
    scene = draw_scene(0)
    for capacity in (10, 200, 600):
        output = draw_with(as_settings(capacity=capacity), scene)
        assert capacity > 10 or output.overflow
        if not output.overflow:
            assert_same(output, render_scene(scene, "float32"), 1e-6)
    views = [scene._replace(viewmat=other.viewmat, K=other.K) for other in map(draw_scene, (0, 1, 2))]
    gaussians, _, textures = inputs_of(scene)
    settings = a2tg.plan_render(gaussians, [as_camera(view, "float32") for view in views], textures)
    assert not any(draw_with(settings, view).overflow for view in views)


def test_cameras_can_be_batched():
    scene = draw_scene(2)
    gaussians, camera, textures = inputs_of(scene)
    views = []
    for offset in ([0, 0, 0], [0.1, 0, 0], [0, -0.2, 0.3]):
        viewmat = scene.viewmat.copy()
        viewmat[:3, 3] += offset
        views.append(scene._replace(viewmat=viewmat))
    cameras = [as_camera(view, "float32") for view in views]
    settings = a2tg.plan_render(gaussians, cameras, textures)
    background = jnp.asarray(scene.background, jnp.float32)

    def draw(viewmat):
        view = a2tg.Camera(viewmat, camera.K, camera.width, camera.height)
        return a2tg.render_image(gaussians, view, textures, background=background, settings=settings)

    batched = jax.jit(jax.vmap(draw))(jnp.stack([view.viewmat for view in cameras]))
    for i, view in enumerate(views):
        assert_same(jax.tree.map(lambda x, i=i: x[i], batched), render_scene(view, "float32"), 3e-4)


@pytest.mark.parametrize("has_textures", [False, True])
def test_no_gaussians_show_the_background(has_textures):
    nothing = a2tg.init_from_points([[0, 0, 1], [0, 0, 2]], np.zeros((2, 3)))[:0]
    textures = a2tg.allocate_textures(np.zeros((0, 2), np.int64)) if has_textures else None
    camera = a2tg.Camera(jnp.eye(4), jnp.asarray([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), 17, 13)

    def draw(gaussians):
        return a2tg.render_image(gaussians, camera, textures, background=(0.1, 0.2, 0.3))

    output = draw(nothing)
    np.testing.assert_array_equal(output.color, np.broadcast_to(np.float32([0.1, 0.2, 0.3]), (13, 17, 3)))
    assert not output.alpha.any() and not output.overflow
    assert jax.grad(lambda gaussians: draw(gaussians).color.sum())(nothing).sh.shape == (0, 16, 3)
