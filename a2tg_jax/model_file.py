"""Models on disk: Gaussians, appearance and origin in one archive, without padding.

The header has the appearance's class and options. Reading a file imports nothing: other packages' classes must be
passed, or their modules be imported already.
"""

import dataclasses
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax import appearance as built_in
from a2tg_jax.appearance import Appearance, Bands, Exponents, Texture, TextureOptions
from a2tg_jax.appearance.base import PARTS, without_arrays
from a2tg_jax.appearance.files import arrays_of, with_arrays
from a2tg_jax.base.archive import arrays_below, read_archive, write_archive
from a2tg_jax.base.checks import check_shape
from a2tg_jax.base.config_json import config_from_dict, config_to_dict
from a2tg_jax.base.regular_files import reading
from a2tg_jax.base.suffixes import checked_path
from a2tg_jax.base.text import shortened
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.core.origin import BLACK, Color, Origin
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.model import Model, check_model, checked_live

FORMAT = "a2tg-jax model"
FIELDS = tuple(field.name for field in dataclasses.fields(Gaussians))
# Prefixes of the names of arrays.
APPEARANCE = "appearance/"
ORIGIN = "origin/"
CORRECTIONS = "corrections/"
ORIGIN_KINDS: dict[str, tuple[str, str, Any]] = {
    "sizes": ("iu", "integers", np.int64),
    "is_test": ("b", "bool", np.bool_),
}
"""Kinds of an origin's arrays that are not floats, in words, and their type."""


def save_model(path: str | os.PathLike[str], model: Model, header: Mapping[str, object] | None = None) -> None:
    """Write a model's live rows, appearance and origin.

    Args:
      path: the file, conventionally *.npz; an existing one is replaced once the new one is complete.
      model: any model.
      header: further values that JSON can hold, to store with it.

    Raises:
      ValueError: if the suffix is another format's, the model is invalid (such as by numbers that are not finite), or
        the appearance's options cannot be written as JSON.

    Examples:
      >>> a2tg.save_model("scene.npz", model)
      >>> a2tg.load_model("scene.npz").num_bytes == model.num_bytes
      True
    """
    path = checked_path(path, "save_model")
    model = checked_live(model)
    arrays = {name: np.asarray(getattr(model.gaussians, name)) for name in FIELDS}
    shown = arrays_of(model.appearance, model.gaussians.sh_degree)
    arrays |= {APPEARANCE + name: np.asarray(array) for name, array in shown.items()}
    described = {**(header or {}), "appearance": appearance_to_dict(model.appearance)}
    described["background"] = list(model.background)
    if model.origin is not None:
        described["origin"] = origin_header(model.origin)
        arrays |= {ORIGIN + name: array for name, array in origin_arrays(model.origin).items()}
        arrays |= {ORIGIN + CORRECTIONS + name: rows for name, rows in model.origin.corrections.items()}
    write_archive(path, described, arrays, format=FORMAT)


def load_model(path: str | os.PathLike[str], *, appearances: Sequence[type[Appearance]] = ()) -> Model:
    """Return the model that `save_model` wrote.

    Args:
      path: the file.
      appearances: appearance classes of other packages.

    Returns:
      The model, with its appearance and origin.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is not a model, is damaged, has another version, or an appearance of an unknown class.

    Examples:
      >>> a2tg.save_model("scene.npz", model)
      >>> a2tg.load_model("scene.npz").render(camera).color.shape
      (36, 48, 3)
    """
    path = checked_path(path, "load_model")
    header, arrays = read_archive(path, format=FORMAT)
    with reading(path):
        gaussians = Gaussians(**{name: arrays[name] for name in FIELDS})  # type: ignore[arg-type]
        check_gaussians(gaussians)
        gaussians = jax.tree.map(jnp.asarray, gaussians)
        appearance = appearance_from_dict(header["appearance"], appearances)
        origin = origin_of(header["origin"], arrays_below(ORIGIN, arrays)) if "origin" in header else None
        appearance = with_arrays(appearance, arrays_below(APPEARANCE, arrays), gaussians.sh_degree)
        model = Model(gaussians, appearance, background=background_of(header), origin=origin)
        check_model(model)
        return model


def number_in_file(path: Path) -> int:
    """Return the number of Gaussians in a model file, by reading only their means. FileNotFoundError: there is no such
    file. ValueError: it is not a model, is damaged, or has another version."""
    # SH are most of a model's bytes.
    means = read_archive(path, format=FORMAT, names=("means",))[1]["means"]
    check_shape(f"{path}: means", means, ("N", 3))
    return len(means)


# Appearances


PART_CLASSES: dict[str, type] = {"texture": Texture, "exponents": Exponents, "bands": Bands}
OLD_PARTS: dict[str, Any] = {"Shaped": {"exponents": Exponents()}, "Banded": {"bands": Bands()}}
"""Wrappers of version 0.2, and the parts that replace them."""


def appearance_to_dict(appearance: Appearance) -> dict[str, Any]:
    """Return the class and options of an appearance and of its parts."""
    kind = type(appearance)
    parts = {name: getattr(appearance, name) for name in PARTS}
    described = {
        "module": kind.__module__,
        "name": kind.__qualname__,
        "options": _options_of(appearance),
        "parts": {name: _options_of(part) for name, part in parts.items() if part is not None},
    }
    try:
        # Tried now: otherwise a model is lost only when someone loads it.
        back = _appearance_of(kind, json.loads(json.dumps(described, allow_nan=False)))
    except (TypeError, ValueError) as error:
        raise ValueError(f"the options of {kind.__name__} cannot be kept in a file: {error}") from error
    # JSON turns tuples into lists and keys into texts, which not every option survives.
    if back != appearance.template:
        raise ValueError(f"the options of {kind.__name__} do not survive JSON: {described['options']}")
    return described


def appearance_from_dict(data: Mapping[str, Any], appearances: Sequence[type[Appearance]] = ()) -> Appearance:
    """Return the template that `appearance_to_dict` or version 0.2 described. ValueError: its class is unknown."""
    name = data["name"]
    options = data["options"]
    module = data["module"]
    is_built_in = module.partition(".")[0] == __name__.partition(".")[0]
    if is_built_in and "parts" not in data:
        if name in OLD_PARTS:
            return dataclasses.replace(appearance_from_dict(data["held"]["inner"], appearances), **OLD_PARTS[name])
        if name == "Textured":
            return Appearance(texture=config_from_dict(Texture, options, "options of Textured", given={"texels": None}))
        if name == "Plain":
            return Appearance(max_alpha=config_from_dict(TextureOptions, options, "options of Plain").max_alpha)
    # The class was passed, is this package's, or is in a module that is already imported.
    kind: Any = next((each for each in appearances if each.__qualname__ == name), None)
    if kind is None and is_built_in:
        kind = getattr(built_in, name, None)
    if kind is None:
        kind = getattr(sys.modules.get(module), name, None)
    if not (isinstance(kind, type) and issubclass(kind, Appearance)):
        raise ValueError(
            f"has the appearance {name} of the module {module}, which is unknown: import that module first, "
            f"or pass the class, load_model(path, appearances=({name.rpartition('.')[2]},))"
        )
    return _appearance_of(kind, data)


def _options_of(node: Any) -> dict[str, Any]:
    """Return the static fields of an appearance, or of a part."""
    # Static fields are options; the others are arrays, which the archive holds.
    names = [field.name for field in dataclasses.fields(node) if field.metadata.get("static")]
    options = config_to_dict(without_arrays(node, lambda path: None))
    return {name: value for name, value in options.items() if name in names}


def _appearance_of(kind: type[Appearance], data: Mapping[str, Any]) -> Appearance:
    def read(kind: type, options: Mapping[str, Any], parts: Mapping[str, object]) -> Any:
        arrays = {field.name: None for field in dataclasses.fields(kind) if not field.metadata.get("static")}
        return config_from_dict(kind, options, f"options of {kind.__name__}", given={**arrays, **parts})

    parts = {name: read(PART_CLASSES[name], options, {}) for name, options in data.get("parts", {}).items()}
    return read(kind, data["options"], parts)


# Origins


def background_of(header: Mapping[str, Any]) -> Color:
    """Return the background of a model in a file; version 0.2 kept it in the origin."""
    red, green, blue = header.get("background") or header.get("origin", {}).get("background", BLACK)
    return float(red), float(green), float(blue)


def origin_header(origin: Origin) -> dict[str, Any]:
    """Return what JSON keeps of an origin: the names, and the vertical if it was chosen."""
    header: dict[str, Any] = {"names": list(origin.names)}
    if origin.up is not None:
        header["up"] = np.asarray(origin.up).tolist()
    return header


def origin_arrays(origin: Origin) -> dict[str, np.ndarray]:
    """Return the numbers of an origin."""
    of_cameras = {name: getattr(origin, name) for name in ("viewmats", "Ks", "sizes", "is_test")}
    world = dataclasses.asdict(origin.transform)
    return of_cameras | {name: np.asarray(numbers, np.float64) for name, numbers in world.items()}


def origin_shapes(num: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of an origin of some cameras."""
    return {
        "viewmats": (num, 4, 4), "Ks": (num, 3, 3), "sizes": (num, 2), "is_test": (num,), "scale": (),
        "rotation": (3, 3), "translation": (3,),
    }  # fmt: skip


def origin_of(data: Mapping[str, object], arrays: Mapping[str, Any]) -> Origin:
    """Return the origin of `origin_arrays`, which may be nested lists, and of `origin_header`. ValueError: a shape or a
    number is wrong."""
    names = data["names"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"origin/names must be texts; got {shortened(names)}")
    checked: dict[str, Any] = {}
    for name, shape in origin_shapes(len(names)).items():
        kinds, what, dtype = ORIGIN_KINDS.get(name, ("iuf", "numbers", np.float64))
        array = np.asarray(arrays[name])
        if not array.size:  # An empty list has no type.
            array = array.reshape(shape).astype(dtype)
        if array.dtype.kind not in kinds:
            raise ValueError(f"{ORIGIN}{name} must be {what}; got {array.dtype}")
        check_shape(ORIGIN + name, array, shape)
        checked[name] = array.astype(dtype)
    world = Similarity(float(checked.pop("scale")), checked.pop("rotation"), checked.pop("translation"))
    up: Any = data.get("up")
    if up is not None:
        up = np.asarray(up, np.float64)
        check_shape(ORIGIN + "up", up, (3,))
    corrections = arrays_below(CORRECTIONS, arrays)
    return Origin(**checked, names=tuple(names), transform=world, corrections=corrections, up=up)
