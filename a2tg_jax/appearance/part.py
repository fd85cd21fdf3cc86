"""Optional parts of an appearance: a texture, the exponents of kernels, bands of spherical harmonics."""

from typing import Any, Self

from jax import Array

from a2tg_jax.core.gaussians import Gaussians


class Part:
    """Part of an appearance: static options, and arrays with a row for each Gaussian, None until they are allocated."""

    def allocate(self, gaussians: Gaussians) -> Self:
        """Return the part with initial arrays for N Gaussians (host)."""
        raise NotImplementedError

    def project(self) -> Self:
        """Return the part with its numbers moved to where they are allowed, after an update; traceable."""
        return self

    def rates(self, rate: Any) -> Any:
        """Return Adam's learning rates, a prefix of the part's tree of floats."""
        return rate

    def check(self, gaussians: Gaussians) -> None:
        """Raise ValueError unless the arrays fit the Gaussians (host)."""


Residual = tuple[Array, ...] | None
"""Added to the D colours; None stands for 0."""
Factor = Array | None
"""Multiplies alpha; None stands for 1."""
