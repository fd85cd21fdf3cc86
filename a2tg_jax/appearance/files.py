"""Arrays of appearances in files: named, without padding.

Arrays of parts are called sizes, texels, shapes, degrees, base_degree and band_l. An array of a subclass has the path
of its field, a table of a subclass FIELD.sizes and FIELD.elements. Version 0.2 wrapped one appearance into another,
whose arrays were `inner.NAME`.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.base import Appearance, added_fields, allocate_appearance
from a2tg_jax.appearance.parts import (
    MAX_DEGREE,
    Bands,
    Coefficients,
    Exponents,
    bands_of_dense,
    degrees_of_sizes,
    dense_bands,
)
from a2tg_jax.base.checks import Wanted, check_shape
from a2tg_jax.core.gaussians import no_rows
from a2tg_jax.core.pytree import is_shared
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.core.table import Table, is_table, is_whole
from a2tg_jax.texture import Textures, checked_sizes

OLD_INNER = "inner."
"""Prefix of the arrays of a wrapped appearance in files of version 0.2."""


def arrays_of(appearance: Appearance, sh_degree: int) -> dict[str, np.ndarray]:
    """Return named arrays without padding, which `with_arrays` reads (host). All rows of the appearance exist;
    `sh_degree` is the degree of their own spherical harmonics."""
    arrays: dict[str, np.ndarray] = {}
    coefficients = appearance.coefficients
    if coefficients is not None:
        degrees = degrees_of_sizes(coefficients.sizes, sh_degree)
        dense = dense_bands(coefficients, sh_degree)
        arrays |= {"degrees": degrees.astype(np.uint8), "base_degree": np.asarray(sh_degree, np.uint8)}
        for band in range(sh_degree + 1, MAX_DEGREE + 1):
            # Rows of the Gaussians that have the band, in their order.
            arrays[f"band_{band}"] = dense[degrees >= band, _columns(band, sh_degree)]
    if appearance.exponents is not None:
        arrays["shapes"] = np.asarray(appearance.exponents.shapes)
    if appearance.texture is not None and appearance.texture.texels is not None:
        textures = appearance.texture.texels
        arrays |= {"sizes": textures.sizes, "texels": textures.flat()}
    for field in added_fields(appearance):
        for path, leaf in jax.tree_util.tree_leaves_with_path(getattr(appearance, field), is_leaf=is_table):
            name = field + jax.tree_util.keystr(path)
            if isinstance(leaf, Table):
                arrays |= {f"{name}.sizes": leaf.sizes, f"{name}.elements": leaf.flat()}
            else:
                arrays[name] = np.asarray(leaf)
    return arrays


def with_arrays(template: Appearance, arrays: Mapping[str, np.ndarray], sh_degree: int) -> Appearance:
    """Return an appearance of the options of a template, with the arrays of a file, as `arrays_of` returns them or
    version 0.2 wrote them (host). ValueError: an array is missing, or its shape does not fit the others."""
    # A field may have such a name itself.
    arrays = {name.replace(OLD_INNER, ""): array for name, array in arrays.items()} | {**arrays}
    changes: dict[str, Any] = {}
    if template.bands is not None:
        changes["bands"] = Bands(_coefficients(arrays, sh_degree))
    if template.exponents is not None:
        shapes = _array(arrays, "shapes")
        if shapes.ndim != 1 or not np.issubdtype(shapes.dtype, np.floating):
            raise ValueError(f"shapes must be floats [N]; got {shapes.dtype}{list(shapes.shape)}")
        changes["exponents"] = Exponents(jnp.asarray(shapes))
    if template.texture is not None:
        changes["texture"] = dataclasses.replace(template.texture, texels=_textures(arrays, "sizes", "texels"))
    # Two rows are enough to learn the structure of a subclass's arrays and the shape of a row.
    example = allocate_appearance(template, jax.random.key(0), no_rows(2, 1))
    added = added_fields(template)

    def read(path: Any, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path).removeprefix(".")
        if path[0].name not in added:
            return leaf
        if is_shared(leaf):
            return jax.tree_util.tree_map_with_path(lambda inner, x: read_array((*path, *inner), x.shape), leaf)
        if isinstance(leaf, Table):
            if f"{name}.sizes" not in arrays:  # Version 0.2 named the pictures of billboards like textures.
                return _textures(arrays, "sizes", "texels")
            return _textures(arrays, f"{name}.sizes", f"{name}.elements")
        return read_array(path, ("N", *leaf.shape[1:]))

    def read_array(path: Any, wanted: Wanted) -> Array:
        name = jax.tree_util.keystr(path).removeprefix(".")
        array = _array(arrays, name)
        check_shape(name, array, wanted)
        return jnp.asarray(array)

    filled = jax.tree_util.tree_map_with_path(read, example, is_leaf=is_whole)
    return dataclasses.replace(template, **changes, **{field: getattr(filled, field) for field in added})


def _array(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    if name not in arrays:
        raise ValueError(f"the array {name} of the appearance is missing")
    return arrays[name]


def _textures(arrays: Mapping[str, np.ndarray], sizes_name: str, texels_name: str) -> Textures:
    sizes = checked_sizes(_array(arrays, sizes_name), sizes_name)
    texels = _array(arrays, texels_name)
    if texels.shape != (int(np.prod(sizes, axis=1).sum()), 4):
        raise ValueError(f"{sizes_name} [N, 2] and {texels_name} [M, 4] disagree; got {sizes.shape} and {texels.shape}")
    return Textures.of_flat(sizes, texels)


def _coefficients(arrays: Mapping[str, np.ndarray], sh_degree: int) -> Coefficients:
    degrees = _array(arrays, "degrees")
    base = int(_array(arrays, "base_degree"))
    if degrees.ndim != 1 or not np.issubdtype(degrees.dtype, np.integer):
        raise ValueError(f"degrees must be integers [N]; got {degrees.dtype} {degrees.shape}")
    if base != sh_degree:
        raise ValueError(f"bands are above degree {base}, but the Gaussians have degree {sh_degree}")
    degrees = degrees.astype(np.int64)
    dtype = np.dtype(np.float32)
    bands = {}
    for band in range(base + 1, MAX_DEGREE + 1):
        array = arrays.get(f"band_{band}")
        shape = (int(np.count_nonzero(degrees >= band)), 2 * band + 1, 3)
        if array is None or array.shape != shape:
            raise ValueError(f"band_{band} must be {list(shape)}; got {None if array is None else array.shape}")
        bands[band] = array
        dtype = array.dtype
    dense = np.zeros((len(degrees), NUM_BASES[MAX_DEGREE] - NUM_BASES[base], 3), dtype)
    for band, array in bands.items():
        dense[degrees >= band, _columns(band, base)] = array
    return bands_of_dense(dense, degrees, base)


def _columns(band: int, base: int) -> slice:
    """Return the columns of a band in `dense_bands`."""
    return slice(NUM_BASES[band - 1] - NUM_BASES[base], NUM_BASES[band] - NUM_BASES[base])
