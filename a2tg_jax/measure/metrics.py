"""Metrics: PSNR, SSIM and LPIPS on images clipped to [0, 1], and the bytes of a model's parameters.

Images are [H, W, 3] floats. Renders may exceed 1 in places; outside transformations of JAX, an image of a mean above 2,
such as one in 0..255, is refused. A mask is [H, W] bool, True where a pixel counts; elsewhere both images are black.
LPIPS takes its network from a weights file, which this package does not contain.
"""

import dataclasses
import functools
import os
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.base.checks import check_kind, check_mask, plain_array
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.npz import read_npz
from a2tg_jax.base.regular_files import expanded, is_regular
from a2tg_jax.base.text import shortened
from a2tg_jax.core.budget import BYTES_PER_FLOAT
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.numerics import safe_norm
from a2tg_jax.texture import BYTES_PER_TEXEL, Textures
from a2tg_jax.training import losses

LPIPS_MIN_SIDE = 32  # A stride of 4 and two poolings, or of 2 and three, must leave pixels.


def psnr(image: Array, target: Array, mask: Array | None = None) -> Array:
    """Return the peak signal-to-noise ratio in dB, -10·log10(mean squared error); infinite for equal images.

    Args:
      image: [H, W, 3], clipped to [0, 1] first.
      target: [H, W, 3], likewise.
      mask: pixels that count, at least one; the mean is over these.

    Returns:
      A scalar in dB; higher is better.

    Raises:
      ValueError: if the shapes differ, an image is in 0..255, or the mask is not boolean.

    Examples:
      >>> image, target = jnp.zeros((16, 16, 3)), jnp.full((16, 16, 3), 0.1)
      >>> round(float(a2tg.psnr(image, target)), 2)
      20.0
    """
    image, target = _clip_pair(image, target, mask)
    error = jnp.mean((image - target) ** 2)
    # Both images are black where pixels do not count: the mean is rescaled to those that do.
    return -10 * jnp.log10(error if mask is None else error / jnp.mean(jnp.asarray(mask, error.dtype)))


def ssim(image: Array, target: Array, mask: Array | None = None) -> Array:
    """Return the structural similarity (Wang et al., 2004) of the images clipped to [0, 1], in windows of 11 × 11.

    Args:
      image: [H, W, 3], sides of at least 11 pixels.
      target: [H, W, 3].
      mask: pixels that count; the mean is over the windows with at least one of them.

    Returns:
      A scalar in [-1, 1]; 1 for equal images.

    Raises:
      ValueError: if the shapes differ, an image is in 0..255, the mask is not boolean, or a side is shorter than 11
        pixels.

    Examples:
      >>> photograph = jnp.asarray(a2tg.view_image(scene.test[0]))
      >>> round(float(a2tg.ssim(photograph, photograph)), 4)
      1.0
    """
    similarity = losses.mean_ssim(*_clip_pair(image, target, mask))
    if mask is None:
        return similarity
    # Windows without counted pixels are equal, and count 1 each.
    window = (losses.SSIM_WINDOW, losses.SSIM_WINDOW)
    counts = jnp.asarray(mask).astype(similarity.dtype)
    # The windows of `mean_ssim`: VALID, stride 1.
    counts = jax.lax.reduce_window(counts, -jnp.inf, jax.lax.max, window, (1, 1), "VALID")
    # docs/equations.md, Measuring: 1 − (1 − SSIM)·n/n'.
    return 1 - (1 - similarity) / jnp.mean(counts)


@dataclasses.dataclass(frozen=True, eq=False)
class LpipsWeights(NamedFields):
    """A feature network and the linear layers that weight its channels (LPIPS v0.1)."""

    network: str
    """"alex" or "squeeze"; figures of different networks are not comparable."""
    arrays: Mapping[str, np.ndarray]
    """`features.N.weight` and `.bias` in torchvision's layout (OIHW), `linI.weight` [1, C, 1, 1]."""


def load_lpips(path: str | os.PathLike[str]) -> LpipsWeights:
    """Read LPIPS weights from an .npz file, once per path; the names of the arrays decide the network.

    Args:
      path: the file.

    Returns:
      The weights, for `lpips`.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it does not hold LPIPS weights of AlexNet or SqueezeNet.
    """
    return _load_lpips(expanded(path).resolve())


def lpips(
    image: Array, target: Array, weights: LpipsWeights | str | os.PathLike[str], mask: Array | None = None
) -> Array:
    """Return the learned perceptual distance (LPIPS v0.1, Zhang et al., 2018) of the images clipped to [0, 1].

    Args:
      image: [H, W, 3], sides of at least 32 pixels.
      target: [H, W, 3].
      weights: from `load_lpips`, or the path of the file.
      mask: pixels that count; the mean is still over the whole image.

    Returns:
      A scalar, 0 for equal images; lower is better.

    Raises:
      ValueError: if the shapes differ, an image is in 0..255, the mask is not boolean, or a side is too short, or as
        `load_lpips` does.

    Examples:
      >>> photograph = jnp.asarray(a2tg.view_image(scene.test[0]))
      >>> float(a2tg.lpips(photograph, photograph, "lpips.npz"))
      0.0
    """
    if not isinstance(weights, LpipsWeights):
        weights = load_lpips(weights)
    pair = jnp.stack(_clip_pair(image, target, mask))
    if min(pair.shape[1:3]) < LPIPS_MIN_SIDE:
        raise ValueError(
            f"LPIPS needs sides of at least {LPIPS_MIN_SIDE} pixels; got {pair.shape[2]} by {pair.shape[1]}"
        )
    # Constants of LPIPS's ScalingLayer: ImageNet's mean and deviation for inputs in [−1, 1].
    shift = jnp.asarray([[[[-0.030, -0.088, -0.188]]]], pair.dtype)
    scale = jnp.asarray([[[[0.458, 0.448, 0.450]]]], pair.dtype)
    features = _FEATURES[weights.network](weights.arrays, (2 * pair - 1 - shift) / scale)
    distances = []
    for index, feature in enumerate(features):  # Spatial means of weighted squared differences of unit features.
        # 1e-10 as in LPIPS's normalize_tensor; safe_norm has a gradient at 0.
        first, second = feature / (safe_norm(feature, keepdims=True) + 1e-10)
        linear = jnp.asarray(weights.arrays[f"lin{index}.weight"], feature.dtype).reshape(1, 1, -1)
        distances.append(jnp.mean(jnp.sum(linear * (first - second) ** 2, axis=-1)))
    return jnp.sum(jnp.stack(distances))


def parameter_bytes(gaussians: Gaussians, textures: Textures | None = None) -> int:
    """Return the reported bytes: 232 a Gaussian (of degree 3) and 16 a texel, 1×1 textures counted, padding not.

    Args:
      gaussians: the live Gaussians only.
      textures: their textures; None without textures.

    Returns:
      Bytes of float32 numbers.

    Raises:
      ValueError: if an argument has the wrong type.
    """
    check_kind("gaussians", gaussians, Gaussians, "use model.num_bytes" if hasattr(gaussians, "num_bytes") else "")
    if textures is not None:
        check_kind("textures", textures, Textures)
    texels = 0 if textures is None else textures.num_texels
    return BYTES_PER_FLOAT * gaussians.floats_per_row * gaussians.num + BYTES_PER_TEXEL * texels


def _clip_pair(image: Array, target: Array, mask: Array | None = None) -> tuple[Array, Array]:
    """Return both images in [0, 1], and black where pixels do not count."""
    image = plain_array("image", image)
    target = plain_array("target", target)
    losses.check_same_shape(image, target)
    image = jnp.clip(image, 0, 1)
    target = jnp.clip(target, 0, 1)
    if mask is None:
        return image, target
    mask = plain_array("mask", mask)
    check_mask("mask", mask, image.shape[:2])
    counts = jnp.asarray(mask)[..., None]
    return jnp.where(counts, image, 0.0), jnp.where(counts, target, 0.0)


@functools.lru_cache(maxsize=4)
def _load_lpips(path: Path) -> LpipsWeights:
    if not is_regular(path):
        raise FileNotFoundError(f"there are no LPIPS weights at {path}: give the path of an .npz file")
    try:
        arrays = read_npz(path)
    except ValueError as error:
        raise ValueError(f"{path} is not an .npz archive of LPIPS weights ({error})") from error
    # Only SqueezeNet has fire modules.
    network = "squeeze" if "features.3.squeeze.weight" in arrays else "alex"
    # By shapes only: nothing is computed.
    image = jax.ShapeDtypeStruct((1, LPIPS_MIN_SIDE, LPIPS_MIN_SIDE, 3), jnp.float32)
    try:
        features = jax.eval_shape(functools.partial(_FEATURES[network], arrays), image)
        linear = [arrays[f"lin{i}.weight"].shape for i in range(len(features))]
    except Exception as error:  # JAX raises many types for shapes that do not fit.
        raise ValueError(
            f"{path} does not hold LPIPS weights of AlexNet or SqueezeNet (taken for {network}): "
            f"{shortened(str(error), 200)}"
        ) from error
    if linear != [(1, feature.shape[-1], 1, 1) for feature in features]:
        raise ValueError(f"{path}: the linear layers do not fit the channels of {network}")
    if not all(np.isfinite(array).all() for array in arrays.values()):
        raise ValueError(f"{path}: weights must be finite; some are NaN or infinite")
    return LpipsWeights(network, arrays)


def _alexnet(arrays: Mapping[str, np.ndarray], x: Array) -> list[Array]:
    """Return the five ReLU outputs of torchvision's AlexNet that LPIPS compares; x and they are NHWC."""
    outputs = [_conv_relu(arrays, "features.0", x, stride=4, padding=2)]
    # torchvision's indices; pooling comes before the second and third convolution only.
    for layer, padding in ((3, 2), (6, 1), (8, 1), (10, 1)):
        pooled = _max_pool(outputs[-1]) if layer < 8 else outputs[-1]
        outputs.append(_conv_relu(arrays, f"features.{layer}", pooled, padding=padding))
    return outputs


def _squeezenet(arrays: Mapping[str, np.ndarray], x: Array) -> list[Array]:
    """Return the seven outputs of torchvision's SqueezeNet 1.1 that LPIPS compares; x and they are NHWC."""
    x = _conv_relu(arrays, "features.0", x, stride=2)
    outputs = [x]
    for layer in (3, 4, 6, 7, 9, 10, 11, 12):
        if layer in (3, 6, 9):
            x = _max_pool(x, is_ceil=True)
        # A fire module: squeeze, then expand with 1×1 and 3×3 kernels side by side.
        squeezed = _conv_relu(arrays, f"features.{layer}.squeeze", x)
        narrow = _conv_relu(arrays, f"features.{layer}.expand1x1", squeezed)
        wide = _conv_relu(arrays, f"features.{layer}.expand3x3", squeezed, padding=1)
        x = jnp.concatenate([narrow, wide], axis=-1)
        # LPIPS takes the last fire module before each pooling, and all after the last.
        if layer not in (3, 6):
            outputs.append(x)
    return outputs


_FEATURES = {"alex": _alexnet, "squeeze": _squeezenet}


def _conv_relu(arrays: Mapping[str, np.ndarray], name: str, x: Array, stride: int = 1, padding: int = 0) -> Array:
    kernel = jnp.asarray(arrays[f"{name}.weight"], x.dtype)
    bias = jnp.asarray(arrays[f"{name}.bias"], x.dtype)
    y = jax.lax.conv_general_dilated(
        x,
        kernel,
        window_strides=(stride, stride),
        padding=[(padding, padding)] * 2,
        dimension_numbers=("NHWC", "OIHW", "NHWC"),
        # By default GPUs and TPUs may compute in TF32 or bfloat16, which changes LPIPS.
        precision=jax.lax.Precision.HIGHEST,
    )
    return jax.nn.relu(y + bias.reshape(1, 1, 1, -1))


def _max_pool(x: Array, is_ceil: bool = False) -> Array:
    """Return 3×3 maxima at stride 2; `is_ceil` keeps the last window that only starts inside the image."""
    # As PyTorch's ceil_mode; −inf padding never wins.
    padding = [(0, (size - 3) % 2 if is_ceil else 0) for size in x.shape[1:3]]
    return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 3, 3, 1), (1, 2, 2, 1), [(0, 0), *padding, (0, 0)])
