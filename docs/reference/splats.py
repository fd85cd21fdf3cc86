"""Functions that the readers of all formats share."""

import numpy as np


def dense(bands, degrees):
    """Return coefficients [N, 16, 3] of bands [M, 2l + 1, 3] of the M splats of degree l or more."""
    sh = np.zeros((len(degrees), 16, 3))
    for degree, band in enumerate(bands):
        sh[degrees >= degree, degree**2 : (degree + 1) ** 2] = band
    return sh


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def exponents(logarithms):
    """Return exponents of kernels; rounding may have moved their logarithms beyond 1."""
    return np.exp(np.clip(logarithms, -1, 1))


def with_w(xyz):
    """Return unit quaternions [n, 4] of x, y, z [3, n]."""
    return np.concatenate([np.sqrt(np.maximum(1 - np.sum(xyz**2, axis=0), 0))[None], xyz]).T


def expanded(codes, axes, bits):
    """Return positions [n, 3] of codes [3, n], and of each axis centre, spread, first and last step."""
    steps = 2**bits - 1
    found = [c + s * np.sinh(low + x * (high - low) / steps) for x, (c, s, low, high) in zip(codes, axes, strict=True)]
    return np.stack(found, axis=1)
