"""Pictures of one model: its textures, depth, normals, maps of what varies, and a flight past its cameras."""

import dataclasses
import io
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from PIL import Image

from a2tg_jax.core.cameras import Camera, resize_camera
from a2tg_jax.core.gaussians import SH_C0
from a2tg_jax.core.paths import smooth_path
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderOutput, RenderSettings
from a2tg_jax.renderer import Renderer
from a2tg_jax.results.images import checkered, save_animation, to_uint8
from a2tg_jax.texture import texture_arrays

NUM_TEXTURES, TEXTURE_SIDE, TEXTURE_MARGIN, TEXTURES_PER_ROW = 24, 64, 8, 8
LEAST_ALPHA = 0.5
"""Smallest alpha that shows a depth and a normal."""
DEPTH_RANGE = 5, 95
"""Percentiles of the inverse depths that colours reach from and to."""
DEPTH_STOPS = 5
"""Number of depths in the legend."""
NUM_CHECKERS = 60
"""Squares across a picture, of the ground where nothing is hit."""
FLIGHT_FRAMES, FLIGHT_PER_SECOND, FLIGHT_SIDE = 60, 15, 480


def learned_textures(model: Model) -> np.ndarray | None:
    """Return a sheet of some textures of a model, as opaque as they are, on a chequered ground, in their Gaussians'
    colours and own proportions.

    They are those that add most to the picture: by the spread of their texels times the area of the Gaussian.

    Returns:
      uint8 [H, W, 4], transparent between the textures; None if no Gaussian has more than one texel.
    """
    texture = model.appearance.texture
    if texture is None:
        return None
    texels = texture_arrays(texture.shown())[: model.num]
    areas = np.exp(np.asarray(model.gaussians.log_scales)[: model.num].sum(axis=1))
    spread = np.asarray([own.reshape(-1, 4).var(axis=0).sum() if own.size > 4 else 0.0 for own in texels])
    order = [index for index in np.argsort(-areas * spread)[:NUM_TEXTURES] if spread[index] > 0]
    if not order:
        return None
    colors = 0.5 + SH_C0 * np.asarray(model.gaussians.sh)[:, 0]
    step = TEXTURE_SIDE + TEXTURE_MARGIN
    rows, columns = -(-len(order) // TEXTURES_PER_ROW), min(len(order), TEXTURES_PER_ROW)
    sheet = np.zeros((rows * step - TEXTURE_MARGIN, columns * step - TEXTURE_MARGIN, 4), np.uint8)
    for place, index in enumerate(order):
        scale = TEXTURE_SIDE // max(texels[index].shape[:2])
        large = np.kron(texels[index], np.ones((scale, scale, 1)))  # [h, w, 4]: RGB residual and alpha factor
        alpha, color = np.clip(large[..., 3:], 0, 1), np.clip(colors[index] + large[..., :3], 0, 1)
        picture = to_uint8(alpha * color + (1 - alpha) * checkered(large.shape[:2], TEXTURE_SIDE // 8))
        top, left = (step * number for number in divmod(place, TEXTURES_PER_ROW))
        target = sheet[top : top + picture.shape[0], left : left + picture.shape[1]]
        target[..., :3], target[..., 3] = picture, 255
    return sheet


class DepthPicture(NamedTuple):
    """Depths as colours, evenly in inverse depth: what is far behind the scene takes few colours."""

    picture: np.ndarray
    """uint8 [H, W, 3], near bright; chequered where little or nothing is hit."""
    stops: list[tuple[float, np.ndarray]]
    """Some depths, nearest first, and their colours, [3] in [0, 1]. Depths beyond the first and last are clipped."""


def depth_picture(output: RenderOutput) -> DepthPicture:
    """Return the picture of the depths of a render."""
    is_hit = _is_hit(output)
    inverse = np.asarray(output.alpha) / np.where(is_hit, np.asarray(output.depth), 1.0)
    far, near = np.percentile(inverse[is_hit], DEPTH_RANGE) if is_hit.any() else (1.0, 1.0)
    colors = colormaps["viridis"](np.clip((inverse - far) / max(near - far, 1e-9), 0, 1))[..., :3]
    shares = np.linspace(1, 0, DEPTH_STOPS if near > far else 1)
    stops = [(1 / (far + share * (near - far)), colormaps["viridis"](share)[:3]) for share in shares]
    return DepthPicture(_on_hit(colors, is_hit), stops)


def normal_picture(output: RenderOutput, camera: Camera) -> np.ndarray:
    """Return uint8 [H, W, 3] of the normals seen from the camera: red to the right, green up, blue towards it;
    chequered as in `depth_picture`."""
    normal = np.asarray(output.normal) @ np.asarray(camera.viewmat)[:3, :3].T * (1, -1, -1)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    is_seen = _is_hit(output) & (length[..., 0] > 0)
    return _on_hit(0.5 + 0.5 * normal / np.where(is_seen[..., None], length, 1.0), is_seen)


class LevelMap(NamedTuple):
    """Level of each Gaussian in a property that varies, such as its degree."""

    file: str
    told: str
    levels: np.ndarray
    """[N] integers, each of which has a colour."""
    names: Sequence[str]
    """Meaning of levels 0, 1, …"""


def level_maps(model: Model) -> list[LevelMap]:
    """Return the texels of each Gaussian and its degree, each only if it varies."""
    maps = []
    if model.textures is not None and model.appearance.texture_options is not None:
        levels = np.rint(np.log2(np.maximum(model.textures.sizes.prod(axis=1), 1))).astype(int)
        names = ["1 or none", *(str(2**level) for level in range(1, levels.max() + 1))]
        maps.append(LevelMap("resolutions.png", "the number of its texels", levels, names))
    if model.appearance.bands is not None:
        names = [str(degree) for degree in range(model.degrees.max() + 1)]
        maps.append(LevelMap("degrees.png", "the degree of its view dependence", model.degrees, names))
    return [one for one in maps if len(np.unique(one.levels)) > 1]


def level_colors(num_levels: int) -> np.ndarray:
    """Return [num_levels, 3] colours of levels 0, 1, …, dark to bright."""
    return colormaps["viridis"](np.linspace(0.0, 1.0, max(2, num_levels)))[:num_levels, :3]


def level_picture(model: Model, levels: np.ndarray, camera: Camera, settings: RenderSettings) -> np.ndarray:
    """Return uint8 [H, W, 3] of the Gaussians in the colours of their levels [N], from any direction, on a chequered
    ground. Alpha textures stay, RGB residuals and view dependence go."""
    colors = (level_colors(int(levels.max()) + 1)[levels] - 0.5) / SH_C0
    if model.textures is not None:
        buckets = tuple(bucket.at[..., :3].set(0.0) for bucket in model.textures.buckets)
        model = model.with_textures(dataclasses.replace(model.textures, buckets=buckets))
    model = with_flat_colors(model, np.ones(model.gaussians.num, bool), colors)
    output = Renderer(model, settings=settings, has_geometry=False)(camera)
    behind = (1 - np.asarray(output.alpha))[..., None]
    ground = _ground((camera.height, camera.width)) - np.asarray(model.background)
    return to_uint8(np.asarray(output.color) + behind * ground)


def with_flat_colors(model: Model, is_chosen: np.ndarray, colors: np.ndarray) -> Model:
    """Return a model whose marked Gaussians have coefficients of degree 0 only: `colors`, one for all or [N, 3]."""
    sh = np.where(is_chosen[:, None, None], 0, model.sh)
    sh[:, 0] = np.where(is_chosen[:, None], colors, sh[:, 0])
    return model.with_sh(sh)


def _is_hit(output: RenderOutput) -> np.ndarray:
    """Return [H, W] whether a ray hits enough for a depth and a normal."""
    return (np.asarray(output.alpha) > LEAST_ALPHA) & (np.asarray(output.depth) > 0)


def _on_hit(colors: np.ndarray, is_hit: np.ndarray) -> np.ndarray:
    """Return uint8 [H, W, 3] of colours where something is hit."""
    return to_uint8(np.where(is_hit[..., None], colors, _ground(is_hit.shape)))


def _ground(shape: tuple[int, ...]) -> np.ndarray:
    return checkered(shape, max(1, shape[1] // NUM_CHECKERS))


def flight(model: Model, settings: RenderSettings) -> bytes | None:
    """Return a small animation (WebP) of a smooth flight past the model's cameras; None with fewer than two."""
    cameras = [] if model.origin is None else list(model.origin.cameras)
    if len(cameras) < 2:
        return None
    path = []
    for camera in smooth_path(cameras, FLIGHT_FRAMES):
        scale = min(1.0, FLIGHT_SIDE / max(camera.width, camera.height))
        path.append(resize_camera(camera, *(max(1, round(scale * side)) for side in (camera.width, camera.height))))
    renderer = Renderer(model, cameras=path[::10], settings=settings, has_geometry=False)
    buffer = io.BytesIO()
    pictures = (Image.fromarray(to_uint8(renderer(camera).color)) for camera in path)
    save_animation(buffer, pictures, FLIGHT_PER_SECOND, quality=75, method=2)
    return buffer.getvalue()
