"""Random scenes for the renderer's tests, as the oracle takes them and as the package takes them.

All numbers are drawn in float32, so that both precisions start from the very same values.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import DEFAULT_RULES, Float, Rules, Scene

from a2tg_jax import (
    Camera,
    Gaussians,
    RenderOutput,
    RenderSettings,
    Textures,
    render_image,
    textures_from_arrays,
)

CAPACITY = 8192
"""Room for the pairs of any scene here; one number for all, so that few renderers are compiled."""

TEXTURE_SIZES = [(1, 1), (1, 4), (4, 1), (2, 2), (4, 4), (8, 8), (16, 16), (2, 1), (16, 2), (3, 5)]
"""(Tv, Tu) of the textures, in turn; the same multiset in every scene, so that their shapes compile once."""


def quick_then_long(quick: list, others: list) -> list:
    """Cases of a test, of which the others run with `--long` only."""
    others = [each if isinstance(each, tuple) else (each,) for each in others]
    return [*quick, *(pytest.param(*each, marks=pytest.mark.long) for each in others)]


Splat = tuple[Float, Float, Float, float]
"""Mean in the camera's frame, quaternion in the camera's frame, log-scales, logit opacity."""


def ordinary(rng: np.random.Generator) -> Splat:
    """A splat in view of a few pixels' size, of middling opacity."""
    depth = rng.uniform(1.5, 5)
    mean = np.array([rng.uniform(-0.6, 0.6) * depth, rng.uniform(-0.5, 0.5) * depth, depth])
    return mean, rng.normal(size=4), rng.uniform(-2.5, -0.3, 2), rng.uniform(-2, 3)


def edge_on(rng: np.random.Generator) -> Splat:
    """A splat whose plane nearly contains the ray to its mean: only the low-pass filter shows it."""
    mean, _, log_scales, logit_opacity = ordinary(rng)
    ray = mean / np.linalg.norm(mean)
    across = np.cross(ray, rng.normal(size=3))
    normal = across / np.linalg.norm(across) + rng.normal(scale=1e-3, size=3)
    return mean, turn_z_to(normal / np.linalg.norm(normal)), log_scales, logit_opacity


def turn_z_to(normal: Float) -> Float:
    """Quaternion wxyz of the shortest rotation that takes +z to a unit vector other than -z."""
    quat = np.array([1 + normal[2], -normal[1], normal[0], 0.0])
    return quat / np.linalg.norm(quat)


def behind(rng: np.random.Generator) -> Splat:
    """A large splat whose mean is behind the camera, though its disc may reach in front of it."""
    _, quat, log_scales, logit_opacity = ordinary(rng)
    return np.array([*rng.normal(size=2), rng.uniform(-2, 0.1)]), quat, log_scales + 1, logit_opacity


def near_crossing(rng: np.random.Generator) -> Splat:
    """A splat just beyond the near plane, whose disc reaches through it."""
    _, quat, _, logit_opacity = ordinary(rng)
    mean = np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.25, 0.6)])
    return mean, quat, rng.uniform(-2.5, -0.5, 2), logit_opacity - 1


def huge(rng: np.random.Generator) -> Splat:
    """A splat that covers the whole screen."""
    mean, quat, _, logit_opacity = ordinary(rng)
    return mean, quat, rng.uniform(1, 3, 2), logit_opacity


def tiny(rng: np.random.Generator) -> Splat:
    """A splat smaller than a pixel."""
    mean, quat, _, logit_opacity = ordinary(rng)
    return mean, quat, rng.uniform(-8, -4.5, 2), logit_opacity


def needle(rng: np.random.Generator) -> Splat:
    """A splat much longer than wide."""
    mean, quat, _, logit_opacity = ordinary(rng)
    return mean, quat, np.array([rng.uniform(-1, 0.5), rng.uniform(-6, -4)]), logit_opacity


def opaque(rng: np.random.Generator) -> Splat:
    """A large splat that almost hides what is behind it: a few of them end a pixel."""
    mean, quat, log_scales, _ = ordinary(rng)
    return mean, quat, log_scales + 1, rng.uniform(4, 8)


def transparent(rng: np.random.Generator) -> Splat:
    """A splat whose opacity is about the smallest that is drawn, 1/255."""
    mean, quat, log_scales, _ = ordinary(rng)
    return mean, quat, log_scales, rng.uniform(-6.5, -4)


KINDS: list[Callable[[np.random.Generator], Splat]] = [
    ordinary,
    edge_on,
    behind,
    near_crossing,
    huge,
    tiny,
    needle,
    opaque,
    transparent,
    ordinary,
]


def draw_texture(rng: np.random.Generator, size: tuple[int, int]) -> Float:
    """[Tv, Tu, 4] signed RGB residuals and alphas in [0, 1]: all of them 1, or some exactly 0 or 1."""
    rgb = rng.normal(scale=0.4, size=(*size, 3))
    alpha = np.clip(rng.uniform(rng.choice([-0.2, 1.0]), 1.4, size=(*size, 1)), 0, 1)
    return np.concatenate([rgb, alpha], axis=-1)


def draw_camera(rng: np.random.Generator, width: int, height: int) -> tuple[Float, Float]:
    """viewmat [4, 4] and K [3, 3] of a camera anywhere, with an off-centre principal point."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    viewmat[:3, 3] = rng.normal(size=3)
    center = np.array([width, height]) * rng.uniform(0.35, 0.65, 2)
    K = np.array([[0.9 * width, 0, center[0]], [0, 0.85 * width, center[1]], [0, 0, 1]])
    return viewmat, K


def to_world(viewmat: Float, mean: Float, quat: Float) -> tuple[Float, Float]:
    """A splat's mean and quaternion in the world, from those in the camera's frame."""
    rotation = viewmat[:3, :3]
    w, x, y, z = quaternion(rotation.T)
    a, b, c, d = quat
    product = [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]
    return rotation.T @ (mean - viewmat[:3, 3]), np.array(product)


def quaternion(rotation: Float) -> Float:
    """Unit quaternion wxyz of a rotation matrix [3, 3]: the dominant eigenvector of Bar-Itzhack's symmetric matrix."""
    r = rotation
    symmetric = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    return np.linalg.eigh(symmetric)[1][:, -1]


def draw_scene(seed: int, num: int = 50, width: int = 43, height: int = 30) -> Scene:
    """`num` splats of every kind in turn, with textures of every size, before a random camera."""
    rng = np.random.default_rng(seed)
    viewmat, K = draw_camera(rng, width, height)
    sizes = [TEXTURE_SIZES[i % len(TEXTURE_SIZES)] for i in rng.permutation(num)]
    splats = [KINDS[i % len(KINDS)](rng) for i in range(num)]
    placed = [to_world(viewmat, mean, quat) for mean, quat, _, _ in splats]
    scene = Scene(
        means=np.array([mean for mean, _ in placed]),
        quats=np.array([quat for _, quat in placed]) * rng.uniform(0.5, 2, (num, 1)),
        log_scales=np.array([log_scales for _, _, log_scales, _ in splats]),
        logit_opacities=np.array([logit_opacity for _, _, _, logit_opacity in splats]),
        sh=rng.normal(size=(num, 16, 3)) * 0.25,
        viewmat=viewmat,
        K=K,
        width=width,
        height=height,
        textures=[draw_texture(rng, size) for size in sizes],
        background=rng.uniform(0, 1, 3),
    )
    return rounded(scene)


def draw_smooth_scene(seed: int, width: int = 16, height: int = 12) -> Scene:
    """Six translucent splats, five about as large as the image and one smaller than a pixel, with textures up to 8×8.

    Whether all pixels keep away from the cut at 1/255, from texel edges and from the other thresholds depends on the
    seed and is for the caller to check on the oracle's image.
    """
    rng = np.random.default_rng(seed)
    viewmat, K = draw_camera(rng, width, height)
    splats = []
    for is_small in [False, False, False, False, False, True]:
        depth = rng.uniform(2, 4)
        mean = np.array([rng.uniform(-0.3, 0.3) * depth, rng.uniform(-0.3, 0.3) * depth, depth])
        mean, quat = to_world(viewmat, mean, np.array([1, *rng.normal(scale=0.35, size=3)]))
        splats.append((mean, quat, rng.uniform(-4.5, -3.5, 2) if is_small else rng.uniform(-0.3, 0.6, 2)))
    sizes = [(1, 1), (1, 3), (4, 1), (2, 2), (4, 4), (8, 8)]
    textures = [0.1 + draw_texture(rng, size) * [0.5, 0.5, 0.5, 0.8] for size in sizes]
    # One alpha is the largest: where several are, a difference quotient sees only one of them move.
    textures[3][0, 0, 3] = 0.95
    return Scene(
        means=np.array([mean for mean, _, _ in splats]),
        quats=np.array([quat for _, quat, _ in splats]),
        log_scales=np.array([log_scales for _, _, log_scales in splats]),
        logit_opacities=rng.uniform(-1, 1, 6),
        sh=rng.normal(size=(6, 16, 3)) * 0.15,
        viewmat=viewmat,
        K=K,
        width=width,
        height=height,
        textures=textures,
        background=rng.uniform(0, 1, 3),
    )


def rounded(scene: Scene) -> Scene:
    """The same scene with every number rounded to float32."""
    round_off = lambda x: np.asarray(x, np.float32).astype(np.float64)  # noqa: E731
    arrays = {name: round_off(value) for name, value in scene._asdict().items() if isinstance(value, np.ndarray)}
    return scene._replace(**arrays, textures=[round_off(texture) for texture in scene.textures])


def as_gaussians(scene: Scene, dtype: str) -> Gaussians:
    """The scene's Gaussians, in the package's form."""
    fields = ("means", "quats", "log_scales", "logit_opacities", "sh")
    return Gaussians(**{name: jnp.asarray(getattr(scene, name), dtype) for name in fields})


def fisheye(camera: Camera) -> Camera:
    """The camera behind an equidistant lens: a pixel at r focal lengths from the middle looks at an angle of r."""
    K = np.asarray(camera.K, np.float64)
    dtype = camera.K.dtype
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    places = np.linalg.solve(K, np.stack([x, y, np.ones_like(x)]).reshape(3, -1))[:2]
    angles = np.linalg.norm(places, axis=0)
    seen = np.concatenate([places * np.tan(angles) / angles, np.ones((1, places.shape[1]))])
    rays = (K @ seen)[:2].T.reshape(camera.height, camera.width, 2)
    return dataclasses.replace(camera, rays=jnp.asarray(rays, dtype))


def as_camera(scene: Scene, dtype: str) -> Camera:
    """The scene's camera, in the package's form."""
    return Camera(jnp.asarray(scene.viewmat, dtype), jnp.asarray(scene.K, dtype), scene.width, scene.height)


def as_textures(scene: Scene, dtype: str) -> Textures | None:
    """The scene's textures, in the package's form; None without textures."""
    if scene.textures is None:
        return None
    return textures_from_arrays([jnp.asarray(texture, dtype) for texture in scene.textures])


def as_settings(rules: Rules = DEFAULT_RULES, **changes: Any) -> RenderSettings:
    """The oracle's rules as the package's settings, with further fields changed; on a GPU, its kernels are tested."""
    if changes.get("compositor") == "native" and jax.default_backend() == "gpu":
        changes["compositor"] = "cuda"
    plain = RenderSettings()
    options = {name: getattr(rules, name) for name in ("uv", "outside", "rgb", "alpha", "max_alpha", "extent")}
    texture = dataclasses.replace(plain.texture, **options)
    return dataclasses.replace(plain, near_plane=rules.near, sh_degree=rules.sh_degree, texture=texture, **changes)


def assert_all_close(found: Any, wanted: Any, rtol: float, atol: float) -> None:
    """Leaves agree; `atol` is in units of the largest entry of each."""
    for one, other in zip(jax.tree.leaves(wanted), jax.tree.leaves(found), strict=True):
        np.testing.assert_allclose(other, one, rtol=rtol, atol=atol * float(abs(np.asarray(one)).max(initial=0)))


@functools.cache
def jitted_renderer(settings: RenderSettings) -> Callable[..., RenderOutput]:
    """`render_image` of (gaussians, camera, textures, background), compiled once for all tests."""

    def draw(gaussians, camera, textures, background):
        return render_image(gaussians, camera, textures, background=background, settings=settings)

    return jax.jit(draw)


def render_scene(scene: Scene, dtype: str, settings: RenderSettings | None = None) -> RenderOutput:
    """The package's image of a scene, checked to be whole."""
    renderer = jitted_renderer(dataclasses.replace(settings or RenderSettings(), capacity=CAPACITY))
    gaussians = as_gaussians(scene, dtype)
    camera = as_camera(scene, dtype)
    background = scene.background
    output = renderer(gaussians, camera, as_textures(scene, dtype), jnp.asarray(background, dtype))
    assert not output.overflow
    return output
