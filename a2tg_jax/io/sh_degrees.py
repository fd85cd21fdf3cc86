"""Degrees of spherical harmonics in files of other programs, some of which go beyond the 3 of this one."""

import warnings

from a2tg_jax.core.sh import NUM_BASES

HIGHEST_DEGREE = len(NUM_BASES) - 1


def degree_to_read(degree: int, name: str) -> int:
    """Return the degree to read of a file's spherical harmonics, at most 3. Warn if the file's is higher.

    Args:
      degree: the degree of the file.
      name: the file, for the warning.
    """
    if degree > HIGHEST_DEGREE:
        message = f"{name}: has SH of degree {degree}; degree {HIGHEST_DEGREE} is read, and what is above it left out"
        warnings.warn(message, stacklevel=4)
    return min(degree, HIGHEST_DEGREE)
