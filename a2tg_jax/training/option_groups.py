"""Groups of the options that every system has: loss weights and corrections of photographs."""

import dataclasses
from typing import Literal

from a2tg_jax.core.checks import check_number, fields_of
from a2tg_jax.training.bilateral import BilateralGrid
from a2tg_jax.training.corrections import Correction, Exposure, PoseRefinement
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

    def check_options(self) -> None:
        """Raise ValueError, beginning with the name of the field, if a number is out of range."""
        for field in dataclasses.fields(self):
            if field.name != "depth_kind":
                check_number(field.name, getattr(self, field.name), least=0)
        check_number("ssim_weight", self.ssim_weight, most=1)
        check_number("robust_share", self.robust_share, most=1)

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
class Corrections:
    """Options of what `exposure` and `refine_poses` learn."""

    exposure_kind: Literal["affine", "grid"] = "affine"
    """Exposure of a photograph: an affine map of its colours, or in addition a bilateral grid of such maps, which
    follows vignettes and local tone mapping."""
    affine: Exposure = Exposure()
    grid: BilateralGrid = BilateralGrid()
    pose: PoseRefinement = PoseRefinement(final_factor=0.1)

    def check_options(self) -> None:
        """Raise ValueError, beginning with the path of the field, if a number is out of range."""
        for name in ("affine", "grid", "pose"):
            with fields_of(name):
                getattr(self, name).check_options()

    def of_stage(self, stage: int, *, exposure: bool, poses: bool) -> tuple[Correction, ...]:
        """Return the corrections of a stage; later stages keep the rates of the first one's end.

        Args:
          stage: index of the stage, from 0.
          exposure: whether exposures are learned.
          poses: whether poses are learned.
        """
        found: list[Exposure | BilateralGrid | PoseRefinement] = []
        if poses:
            found.append(self.pose)
        if exposure:
            found.append(self.affine)
        if exposure and self.exposure_kind == "grid":
            found.append(self.grid)
        if stage:
            found = [dataclasses.replace(one, rate=one.rate * one.final_factor, final_factor=1.0) for one in found]
        return tuple(found)
