"""Image quality and speed of a trained model on given views."""

import dataclasses
import os
import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.text import counted
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.core.origin import Color
from a2tg_jax.measure.alignment import color_fit
from a2tg_jax.measure.metrics import load_lpips, lpips, psnr, ssim
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.render import appearance_of
from a2tg_jax.renderer import Renderer
from a2tg_jax.scene import View, check_are_views, view_image
from a2tg_jax.texture import Textures
from a2tg_jax.training.corrections import exposed
from a2tg_jax.training.reports import ONE_COLOR, flat_psnr, has_learned

NUM_TIMED = 8
"""Views that are timed."""


@dataclasses.dataclass(frozen=True)
class ViewMetrics(NamedFields):
    """Quality of one view, its image clipped to [0, 1]."""

    name: str
    """Name of the view."""
    psnr: float
    """dB, higher is better."""
    ssim: float
    """Structural similarity, at most 1; higher is better."""
    lpips: float | None
    """Lower is better; None without weights."""
    flat_psnr: float
    """PSNR of the best flat colour instead of the render, in dB."""


@dataclasses.dataclass(frozen=True)
class Evaluation(NamedFields):
    """Quality of all views, and rendering speed.

    Photographs of one colour, such as empty ones, count in no mean unless all are: PSNR is infinite where a render is
    empty as well.
    """

    per_view: tuple[ViewMetrics, ...]
    """Quality of each view."""
    lpips_network: str | None
    """Network of the LPIPS figures, which are not comparable with another's; None without LPIPS."""
    frames_per_second: float
    """Median over the first eight views, of the fastest of three warm renders of each."""
    renders: tuple[np.ndarray, ...]
    """Images of the first `num_renders` views, uint8 [H, W, 3]."""

    def __getitem__(self, views: slice) -> "Evaluation":
        """Return the figures of some of the views."""
        return dataclasses.replace(self, per_view=self.per_view[views], renders=self.renders[views])

    def _mean(self, figure: str) -> float:
        views = [view for view in self.per_view if view.flat_psnr < ONE_COLOR] or self.per_view
        return float(np.mean([getattr(view, figure) for view in views]))

    @property
    def psnr(self) -> float:
        """Mean over the views."""
        return self._mean("psnr")

    @property
    def ssim(self) -> float:
        """Mean over the views."""
        return self._mean("ssim")

    @property
    def lpips(self) -> float | None:
        """Mean over the views; None without weights."""
        return None if self.lpips_network is None else self._mean("lpips")

    @property
    def flat_psnr(self) -> float:
        """Mean over the views."""
        return self._mean("flat_psnr")

    @property
    def has_learned(self) -> bool:
        """Whether the model shows more than one flat colour per view."""
        return has_learned(self.psnr, self.flat_psnr)

    def __repr__(self) -> str:
        facts = [counted(len(self.per_view), "view")]
        if self.per_view:
            facts += [f"PSNR {self.psnr:.2f} dB", f"SSIM {self.ssim:.3f}"]
            facts += [] if self.lpips is None else [f"LPIPS {self.lpips:.3f} ({self.lpips_network})"]
        return f"Evaluation({', '.join(facts)}, {self.frames_per_second:.0f} frames/s)"


def evaluate(
    views: Sequence[View],
    gaussians: Gaussians | Model,
    textures: Textures | None = None,
    *,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    background: Color | None = None,
    lpips_weights: str | os.PathLike[str] | None = None,
    num_renders: int = 0,
    fit_colors: bool = False,
) -> Evaluation:
    """Render every view and compare it with its photograph, where its pixels count.

    Args:
      views: at least one.
      gaussians: a model, or N Gaussians.
      textures: textures of the Gaussians; a model has its own.
      settings: static options, as for `render_image`, without a capacity.
      background: RGB behind the Gaussians, and behind photographs with an alpha channel; None is the model's own, or
        black.
      lpips_weights: a weights file for LPIPS; None leaves it out.
      num_renders: number of views, from the first, whose images are returned.
      fit_colors: map each render's colours to its photograph by least squares (`color_fit`), for photographs of unknown
        exposure.

    Returns:
      Means over the views, `psnr` in dB, `ssim` and `lpips`; the figures of each, `per_view`; `frames_per_second`; and
      `renders`, the first images as uint8 [H, W, 3].

    Raises:
      ValueError: if there are no views, or a model is given with textures.
      FileNotFoundError: if `lpips_weights` does not exist.

    Examples:
      >>> found = a2tg.evaluate(scene.test, model)
      >>> len(found.per_view), 5 < found.psnr < 30
      (2, True)
    """
    check_are_views(views, "evaluate(scene.test, model)")
    weights = None if lpips_weights is None else load_lpips(lpips_weights)
    if isinstance(gaussians, Model):
        if textures is not None:
            raise ValueError("textures are part of a model: give the model alone")
        model = gaussians
    else:
        check_gaussians(gaussians)
        model = Model(gaussians, appearance_of(gaussians, textures, settings))
    background = model.background if background is None else background
    cameras = [view.camera for view in views]
    renderer = Renderer(model, cameras=cameras, background=background, settings=settings, has_geometry=False)
    per_view: list[ViewMetrics] = []
    seconds: list[float] = []
    renders: list[np.ndarray] = []
    for view in views:
        image = renderer(view.camera).color
        target = jnp.asarray(view_image(view, background))
        if len(seconds) < NUM_TIMED:
            seconds.append(min(_seconds(renderer, view.camera) for _ in range(3)))
        mask = None if view.mask is None else jnp.asarray(view.mask.read())
        # Not clipped here: the metrics under jit clip both images, and the fit of colours needs them.
        if fit_colors:
            image = exposed(jnp.asarray(color_fit(image, target, mask), image.dtype), image)
        decibels, similarity, flat = (float(figure) for figure in jax.jit(_figures_of)(image, target, mask))
        distance = None if weights is None else float(lpips(jnp.clip(image, 0, 1), target, weights, mask))
        per_view.append(ViewMetrics(view.name, decibels, similarity, distance, flat))
        if len(renders) < num_renders:
            renders.append(np.rint(255 * np.clip(np.asarray(image), 0, 1)).astype(np.uint8))
    network = None if weights is None else weights.network
    return Evaluation(tuple(per_view), network, 1.0 / float(np.median(seconds)), tuple(renders))


def _figures_of(image: Array, target: Array, mask: Array | None) -> tuple[Array, Array, Array]:
    """Return PSNR, SSIM and flat PSNR of a render and its photograph."""
    return psnr(image, target, mask), ssim(image, target, mask), flat_psnr(target, mask)


def _seconds(renderer: Renderer, camera: Camera) -> float:
    """Return the time of one render; JAX dispatches asynchronously."""
    start = time.perf_counter()
    jax.block_until_ready(renderer(camera))
    return time.perf_counter() - start
