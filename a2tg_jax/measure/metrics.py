"""Metrics: PSNR, SSIM, LPIPS on images clipped to [0, 1], and the bytes of its parameters.

Images are [H, W, 3] floats, a mask is [H, W] bool, True where a pixel counts: where one does not, both images are
black. LPIPS takes its network from a weights file, which this package does not contain.
"""

import dataclasses
import functools
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from a2tg_jax.core.budget import BYTES_PER_FLOAT
from a2tg_jax.core.checks import check_kind, check_shape, plain_array
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.numerics import safe_norm
from a2tg_jax.host.npz import read_npz
from a2tg_jax.host.regular_files import is_regular
from a2tg_jax.host.text import shortened
from a2tg_jax.texture import BYTES_PER_TEXEL, Textures
from a2tg_jax.training import losses

LPIPS_MIN_SIDE = 32
LPIPS_LINEAR_LAYERS = {"alex": 5, "squeeze": 7}


def psnr(image: Array, target: Array, mask: Array | None = None) -> Array:
    """Peak signal-to-noise ratio in dB, -10·log10(mean squared error); infinite for equal images.

    Args:
      image: [H, W, 3], clipped to [0, 1] first.
      target: [H, W, 3], likewise.
      mask: the mean is that over the pixels that count, one at least.

    Raises:
      ValueError: if the shapes differ.
    """
    image, target = _clip_pair(image, target, mask)
    error = jnp.mean((image - target) ** 2)
    return -10 * jnp.log10(error if mask is None else error / jnp.mean(jnp.asarray(mask, error.dtype)))


def ssim(image: Array, target: Array, mask: Array | None = None) -> Array:
    """Structural similarity in [-1, 1] (see `training.losses.mean_ssim`) of the images clipped to [0, 1].

    Args:
      image: [H, W, 3], sides of at least 11 pixels.
      target: [H, W, 3].
      mask: the mean is that over the windows in which at least one pixel counts.

    Raises:
      ValueError: if the shapes differ or a side is shorter than 11 pixels.
    """
    similarity = losses.mean_ssim(*_clip_pair(image, target, mask))
    if mask is None:
        return similarity
    # Windows in which nothing counts are equal, and count 1 each.
    return 1 - (1 - similarity) / _share_of_windows(jnp.asarray(mask), similarity.dtype)


@dataclasses.dataclass(frozen=True, eq=False)
class LpipsWeights:
    """A feature network and the linear layers that weigh its channels (LPIPS v0.1)."""

    network: str
    """"alex" or "squeeze"; figures of different networks are not comparable."""
    arrays: Mapping[str, np.ndarray]
    """`features.N.weight` and `.bias` in torchvision's layout (OIHW), `linI.weight` [1, C, 1, 1]."""


def load_lpips(path: str | os.PathLike[str]) -> LpipsWeights:
    """Read LPIPS weights from an .npz file, once per path; the network is told from the arrays in it.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it does not hold LPIPS weights of AlexNet or SqueezeNet.
    """
    return _load_lpips(pathlib.Path(path).resolve())


def lpips(
    image: Array, target: Array, weights: LpipsWeights | str | os.PathLike[str], mask: Array | None = None
) -> Array:
    """Learned perceptual distance (LPIPS v0.1, Zhang et al., 2018) of the images clipped to [0, 1]; 0 is equal.

    Args:
      image: [H, W, 3], sides of at least 32 pixels.
      target: [H, W, 3].
      weights: from `load_lpips`, or the path of the file.
      mask: the mean is still that over the whole image.

    Raises:
      ValueError: if the shapes differ or a side is too short, or as `load_lpips` does.
    """
    if not isinstance(weights, LpipsWeights):
        weights = load_lpips(weights)
    pair = jnp.stack(_clip_pair(image, target, mask))
    if min(pair.shape[1:3]) < LPIPS_MIN_SIDE:
        raise ValueError(
            f"LPIPS needs sides of at least {LPIPS_MIN_SIDE} pixels; got {pair.shape[2]} by {pair.shape[1]}"
        )
    shift = jnp.asarray([[[[-0.030, -0.088, -0.188]]]], pair.dtype)
    scale = jnp.asarray([[[[0.458, 0.448, 0.450]]]], pair.dtype)
    features = _FEATURES[weights.network](weights.arrays, (2 * pair - 1 - shift) / scale)
    distances = [_layer_distance(feature, weights.arrays[f"lin{i}.weight"]) for i, feature in enumerate(features)]
    return jnp.sum(jnp.stack(distances))


def parameter_bytes(gaussians: Gaussians, textures: Textures | None = None) -> int:
    """Reported memory in bytes: 232 a Gaussian (of degree 3) and 16 a texel, 1×1 textures counted, padding not.

    Args:
      gaussians: the live Gaussians only.
      textures: their textures; None without textures.

    Raises:
      ValueError: if one is of another kind.
    """
    check_kind("gaussians", gaussians, Gaussians, "say model.num_bytes" if hasattr(gaussians, "num_bytes") else "")
    if textures is not None:
        check_kind("textures", textures, Textures)
    texels = 0 if textures is None else textures.num_texels
    return BYTES_PER_FLOAT * gaussians.floats_per_row * gaussians.num + BYTES_PER_TEXEL * texels


def _clip_pair(image: Array, target: Array, mask: Array | None = None) -> tuple[Array, Array]:
    """Return both images in [0, 1], and black where pixels do not count."""
    image, target = _converted("image", image), _converted("target", target)
    losses.check_same_shape(image, target)
    image, target = jnp.clip(image, 0, 1), jnp.clip(target, 0, 1)
    if mask is None:
        return image, target
    mask = plain_array("mask", mask)
    check_shape("mask", mask, image.shape[:2])
    counts = jnp.asarray(mask)[..., None]
    return jnp.where(counts, image, 0.0), jnp.where(counts, target, 0.0)


def _converted(name: str, image: Any) -> Any:
    """Return arrays of other libraries and nested lists as arrays of JAX, and all else as it is."""
    image = plain_array(name, image)
    return jnp.asarray(image) if hasattr(image, "__array__") or type(image) in (list, tuple) else image


def _share_of_windows(mask: Array, dtype: DTypeLike) -> Array:
    """Return the share of SSIM's windows in which at least one pixel counts."""
    window = (losses.SSIM_WINDOW, losses.SSIM_WINDOW)
    counts = jax.lax.reduce_window(mask.astype(dtype), -jnp.inf, jax.lax.max, window, (1, 1), "VALID")
    return jnp.mean(counts)


@functools.lru_cache(maxsize=4)
def _load_lpips(path: pathlib.Path) -> LpipsWeights:
    if not is_regular(path):
        raise FileNotFoundError(f"there are no LPIPS weights at {path}: give the path of an .npz file")
    try:
        arrays = read_npz(path)
    except ValueError as error:
        raise ValueError(f"{path} is not an .npz archive of LPIPS weights ({error})") from error
    network = "squeeze" if "features.3.squeeze.weight" in arrays else "alex"
    weights = LpipsWeights(network, arrays)
    _check_weights(path, weights)
    return weights


def _check_weights(path: pathlib.Path, weights: LpipsWeights) -> None:
    """Raise ValueError unless the network runs on these arrays, tried by shapes alone."""
    image = jax.ShapeDtypeStruct((1, LPIPS_MIN_SIDE, LPIPS_MIN_SIDE, 3), jnp.float32)
    try:
        features = jax.eval_shape(functools.partial(_FEATURES[weights.network], weights.arrays), image)
        linear = [weights.arrays[f"lin{i}.weight"] for i in range(LPIPS_LINEAR_LAYERS[weights.network])]
    except Exception as error:  # What JAX makes of shapes that do not fit is of many types.
        raise ValueError(
            f"{path} does not hold LPIPS weights of AlexNet or SqueezeNet (taken for {weights.network}): "
            f"{shortened(str(error), 200)}"
        ) from error
    if [x.shape for x in linear] != [(1, feature.shape[-1], 1, 1) for feature in features]:
        raise ValueError(f"{path}: the linear layers do not fit the channels of {weights.network}")
    if not all(np.isfinite(array).all() for array in weights.arrays.values()):
        raise ValueError(f"{path}: weights must be finite; some are NaN or infinite")


def _layer_distance(features: Array, linear: np.ndarray) -> Array:
    """Spatial mean of the weighted squared difference of the two unit-normalised feature maps [2, h, w, C]."""
    first, second = features / (safe_norm(features, keepdims=True) + 1e-10)
    weights = jnp.asarray(linear, features.dtype).reshape(1, 1, -1)
    return jnp.mean(jnp.sum(weights * (first - second) ** 2, axis=-1))


def _alexnet(arrays: Mapping[str, np.ndarray], x: Array) -> list[Array]:
    """Return the five ReLU outputs of torchvision's AlexNet that LPIPS compares; x and they are NHWC."""
    relu1 = _conv_relu(arrays, "features.0", x, stride=4, padding=2)
    relu2 = _conv_relu(arrays, "features.3", _max_pool(relu1), padding=2)
    relu3 = _conv_relu(arrays, "features.6", _max_pool(relu2), padding=1)
    relu4 = _conv_relu(arrays, "features.8", relu3, padding=1)
    relu5 = _conv_relu(arrays, "features.10", relu4, padding=1)
    return [relu1, relu2, relu3, relu4, relu5]


def _squeezenet(arrays: Mapping[str, np.ndarray], x: Array) -> list[Array]:
    """Return the seven outputs of torchvision's SqueezeNet 1.1 that LPIPS compares; x and they are NHWC."""
    fire = functools.partial(_fire, arrays)
    relu1 = _conv_relu(arrays, "features.0", x, stride=2)
    fire2 = fire("features.4", fire("features.3", _max_pool(relu1, is_ceil=True)))
    fire3 = fire("features.7", fire("features.6", _max_pool(fire2, is_ceil=True)))
    fire4 = fire("features.9", _max_pool(fire3, is_ceil=True))
    fire5 = fire("features.10", fire4)
    fire6 = fire("features.11", fire5)
    fire7 = fire("features.12", fire6)
    return [relu1, fire2, fire3, fire4, fire5, fire6, fire7]


_FEATURES = {"alex": _alexnet, "squeeze": _squeezenet}


def _fire(arrays: Mapping[str, np.ndarray], name: str, x: Array) -> Array:
    """SqueezeNet's fire module: squeeze, then expand with 1×1 and 3×3 kernels side by side."""
    squeezed = _conv_relu(arrays, f"{name}.squeeze", x)
    narrow = _conv_relu(arrays, f"{name}.expand1x1", squeezed)
    wide = _conv_relu(arrays, f"{name}.expand3x3", squeezed, padding=1)
    return jnp.concatenate([narrow, wide], axis=-1)


def _conv_relu(arrays: Mapping[str, np.ndarray], name: str, x: Array, stride: int = 1, padding: int = 0) -> Array:
    kernel = jnp.asarray(arrays[f"{name}.weight"], x.dtype)
    bias = jnp.asarray(arrays[f"{name}.bias"], x.dtype)
    y = jax.lax.conv_general_dilated(
        x,
        kernel,
        window_strides=(stride, stride),
        padding=[(padding, padding)] * 2,
        dimension_numbers=("NHWC", "OIHW", "NHWC"),
        precision=jax.lax.Precision.HIGHEST,
    )
    return jax.nn.relu(y + bias.reshape(1, 1, 1, -1))


def _max_pool(x: Array, is_ceil: bool = False) -> Array:
    """3×3 maximum at stride 2; `is_ceil` keeps the last window that only starts inside the image."""
    padding = [(0, (size - 3) % 2 if is_ceil else 0) for size in x.shape[1:3]]
    pooled: Array = jax.lax.reduce_window(
        x, -jnp.inf, jax.lax.max, (1, 3, 3, 1), (1, 2, 2, 1), [(0, 0), *padding, (0, 0)]
    )
    return pooled
