"""Pictures of one model: its textures, depth, normals, and a flight past its cameras."""

import io
from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib import colormaps
from PIL import Image

from a2tg_jax.core.cameras import Camera, resize_camera
from a2tg_jax.core.gaussians import SH_C0
from a2tg_jax.core.paths import smooth_path
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderOutput, RenderSettings
from a2tg_jax.renderer import Renderer
from a2tg_jax.results.images import checkered, colored_by_level, to_uint8
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
    colours.

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
    return _sheet([_on_checker(texels[index], colors[index]) for index in order])


def _on_checker(texels: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Return uint8 [h, w, 3] of a texture in its own proportions, on a chequered ground.

    Args:
      texels: [Tv, Tu, 4] RGB residual and alpha factor.
      color: [3] of the Gaussian.
    """
    scale = TEXTURE_SIDE // max(texels.shape[:2])
    large = np.kron(texels, np.ones((scale, scale, 1)))
    ground = checkered(large.shape[:2], TEXTURE_SIDE // 8)
    alpha = np.clip(large[..., 3:], 0, 1)
    return to_uint8(alpha * np.clip(color + large[..., :3], 0, 1) + (1 - alpha) * ground)


def _sheet(pictures: list[np.ndarray]) -> np.ndarray:
    """Return pictures in rows, each at the top left of its place."""
    step = TEXTURE_SIDE + TEXTURE_MARGIN
    rows, columns = -(-len(pictures) // TEXTURES_PER_ROW), min(len(pictures), TEXTURES_PER_ROW)
    sheet = np.zeros((rows * step - TEXTURE_MARGIN, columns * step - TEXTURE_MARGIN, 4), np.uint8)
    for index, picture in enumerate(pictures):
        top, left = (step * place for place in divmod(index, TEXTURES_PER_ROW))
        height, width = picture.shape[:2]
        sheet[top : top + height, left : left + width, :3] = picture
        sheet[top : top + height, left : left + width, 3] = 255
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


def level_picture(model: Model, levels: np.ndarray, camera: Camera, settings: RenderSettings) -> np.ndarray:
    """Return uint8 [H, W, 3] of the Gaussians in the colours of their levels, on a chequered ground."""
    output = Renderer(colored_by_level(model, levels), settings=settings, has_geometry=False)(camera)
    behind = (1 - np.asarray(output.alpha))[..., None]
    ground = _ground((camera.height, camera.width)) - np.asarray(model.background)
    return to_uint8(np.asarray(output.color) + behind * ground)


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
    path = [_small(camera) for camera in smooth_path(cameras, FLIGHT_FRAMES)]
    renderer = Renderer(model, cameras=path[::10], settings=settings, has_geometry=False)
    return animation(renderer(camera).color for camera in path)


def _small(camera: Camera) -> Camera:
    """Return the camera with pictures of `FLIGHT_SIDE` at most."""
    scale = min(1.0, FLIGHT_SIDE / max(camera.width, camera.height))
    return resize_camera(camera, *(max(1, round(scale * side)) for side in (camera.width, camera.height)))


def animation(images: Iterable[Array]) -> bytes:
    """Return images [H, W, 3] in [0, 1] as an animated WebP that loops."""
    first, *others = (Image.fromarray(to_uint8(jnp.asarray(image))) for image in images)
    buffer = io.BytesIO()
    duration = round(1000 / FLIGHT_PER_SECOND)
    first.save(buffer, "WEBP", save_all=True, append_images=others, duration=duration, loop=0, quality=75, method=2)
    return buffer.getvalue()
