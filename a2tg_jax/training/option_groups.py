"""Groups of the options that every system has: loss weights, corrections of photographs, pruning of floaters."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

from a2tg_jax.densify.floaters import PruneFloaters
from a2tg_jax.densify.pruning import during_growth
from a2tg_jax.events import Event, FieldError, StepEvent, from_options
from a2tg_jax.host.text import shortened
from a2tg_jax.training.bilateral import BilateralGrid
from a2tg_jax.training.corrections import Exposure, PoseRefinement
from a2tg_jax.training.depth_prior import DepthKind, DepthPrior, PointDepths
from a2tg_jax.training.robust import RobustPhotometric
from a2tg_jax.training.stage import LossTerm
from a2tg_jax.training.terms import Photometric, Term, distortion, l1, normals, opacity, scale


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Weights of the photometric loss and of the optional terms (0 is off, the paper's setting)."""

    ssim_weight: float = Photometric.ssim_weight
    """w in (1 - w)·L1 + w·(1 - SSIM)."""
    normal_weight: float = 0.0
    """Normal consistency of 2DGS: rendered normals against the normals of the rendered depth."""
    distortion_weight: float = 0.0
    """Depth distortion of 2DGS."""
    opacity_weight: float = 0.0
    """Mean opacity of the live splats, or mean alpha of their pictures (3DGS-MCMC and BBSplat use 0.01)."""
    scale_weight: float = 0.0
    """Mean scale of the live Gaussians (3DGS-MCMC uses 0.01)."""
    robust_share: float = 0.0
    """Largest share of each photograph to leave out where it differs most from the render, such as passers-by; 0: none.
    """
    robust_factor: float = RobustPhotometric.factor
    """Least residual of a patch that robust_share leaves out, as a multiple of the photograph's median."""

    depth_weight: float = 0.0
    """Rendered inverse depth against the scene's depth maps, after scale and shift of least squares per view."""
    depth_kind: DepthKind = "inverse"
    """Meaning of depth maps: inverse depth up to scale and shift (monocular networks), or depth up to scale."""
    points_weight: float = 0.0
    """Rendered inverse depth against that of the points that COLMAP observed in each photograph."""

    def terms(self, is_first: bool = True) -> tuple[LossTerm, ...]:
        """Return the loss terms whose weight is not 0.

        Args:
          is_first: whether they are of the first stage, in whose beginning robust_share leaves out nothing.
        """
        optional: tuple[Term | DepthPrior | PointDepths, ...] = (
            Term(normals, self.normal_weight, has_geometry=True),
            Term(distortion, self.distortion_weight, has_geometry=True),
            Term(opacity, self.opacity_weight),
            Term(scale, self.scale_weight),
            DepthPrior(self.depth_weight, self.depth_kind),
            PointDepths(self.points_weight),
        )
        return (self._photometric(is_first), *(term for term in optional if term.weight))

    def _photometric(self, is_first: bool) -> LossTerm:
        if self.robust_share:
            start = RobustPhotometric.start if is_first else 0.0
            has_ssim = self.ssim_weight != 0
            return RobustPhotometric(self.ssim_weight, self.robust_share, self.robust_factor, start, has_ssim)
        return Photometric(self.ssim_weight) if self.ssim_weight else Term(l1)


@dataclasses.dataclass(frozen=True)
class CorrectionConfig:
    """Options of what `exposure` and `refine_poses` learn."""

    exposure_kind: Literal["affine", "grid"] = "affine"
    """Exposure of a photograph: an affine map of its colours, or in addition a bilateral grid of such maps, which
    follows vignettes and local tone mapping."""
    exposure_rate: float = Exposure.rate
    """Adam's learning rate of the affine maps of colours."""
    grid_size: tuple[int, int, int] = BilateralGrid.size
    """Numbers of nodes of a bilateral grid along x, along y, and of luminances, each up to 64."""
    grid_rate: float = BilateralGrid.rate
    """Adam's learning rate of the bilateral grids."""
    grid_smoothness: float = BilateralGrid.smoothness
    """Weight of the total variation of the bilateral grids in the loss."""
    pose_rate: float = PoseRefinement.rate
    """Adam's learning rate of the camera motions, in radians and in units of the normalised world."""
    final_factor: float = Exposure.final_factor
    """Factor of these rates at the end of the first stage, and in later stages."""


@dataclasses.dataclass(frozen=True)
class FloaterConfig:
    """Pruning of floaters in the first stage (`PruneFloaters`)."""

    min_views: int = 0
    """Least number of training views in which a Gaussian must show, at least 2; others are pruned. 0: off."""
    near: float = 0.0
    """Least depth of a Gaussian before each camera that sees it, in units of the normalised world, in which cameras are
    about 1 from what they see, such as 0.2. 0: off."""
    near_share: float = dataclasses.field(default=0.0, metadata={"is_addition": True})
    """Least depth of a Gaussian before each camera that sees it, as a share, below 1, of the depth of the nearest 2 %
    in its picture, such as 0.7. A small foreground that is nearer goes, too. 0: off."""
    at: tuple[float, ...] = PruneFloaters.at
    """Fractions of the first stage at which floaters are pruned. Those after the last growth are left out."""

    @property
    def is_asked(self) -> bool:
        """Whether floaters are to be pruned."""
        return bool(self.min_views or self.near or self.near_share)

    def events(self, num_iterations: int, others: Sequence[Event] = ()) -> tuple[Event, ...]:
        """Return the event; none if nothing is asked for.

        Args:
          num_iterations: length of the stage.
          others: events of the stage, some of which may add Gaussians.

        Raises:
          ValueError: if no fraction is left.
        """
        if not self.is_asked:
            return ()
        event = from_options(PruneFloaters, self)
        event.iterations(num_iterations)
        growing = (each for each in others if isinstance(each, StepEvent) and each.most_gaussians is not None)
        times = [found for each in growing if (found := each.times(num_iterations)).num_times]
        if not times:
            return (event,)
        last = max(times, key=lambda found: found.last_time)
        at = during_growth(self.at, num_iterations, last)
        if not at:
            raise FieldError(
                event,
                f"{{at}} must hold a fraction before the last growth, which is at iteration {last.last_time:,} of "
                f"{num_iterations:,}, for others grow in the place of what is pruned; got {shortened(self.at)}",
            )
        return (dataclasses.replace(event, at=at),)
