"""OpenUSD files of splats: particle fields with a kernel of planar Gaussians, as *.usdz, *.usdc or *.usda.

The kernel ParticleFieldKernelGaussianSurfletAPI of USD 26.03 is exactly this package's Gaussian: it is in the plane of
the first two axes. It cannot hold textures. The library usd-core reads and writes the files.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax import Model
from a2tg_jax.base.atomic import replacing
from a2tg_jax.base.json_text import parse_json
from a2tg_jax.base.npz import read_npz
from a2tg_jax.base.regular_files import MOST_ARRAY_BYTES, check_exists, open_regular, reading
from a2tg_jax.base.suffixes import checked_path
from a2tg_jax.base.text import shortened
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.io import usd_fields
from a2tg_jax.io.other_programs import (
    Ellipsoids,
    degree_to_read,
    joined_parts,
    matrix_of,
    model_of_splats,
    origin_to_json,
    splats_of,
    upright,
)
from a2tg_jax.model import checked_live
from a2tg_jax.model_file import background_of, origin_of

ORIGIN = "a2tg:origin"
"""Name of the origin, as JSON, in the custom data of a particle field."""
ATTRIBUTES = ("Position", "Orientation", "Scale", "Opacity", "SphericalHarmonics")
SURFLET = "ParticleFieldKernelGaussianSurfletAPI"
ELLIPSOID = "ParticleFieldKernelGaussianEllipsoidAPI"


def save_usd(path: str | os.PathLike[str], model: Model, *, ellipsoids: bool = False) -> None:
    """Write a model's live rows as a particle field of OpenUSD, without textures, and with its origin.

    Args:
      path: the file, *.usdz, *.usdc or *.usda; *.usd is a *.usdc. An existing one is replaced once complete.
      model: any model; its splats are as plain as `save_ply` makes them.
      ellipsoids: write a ParticleField3DGaussianSplat with a thin third axis, for programs that draw only these.

    Raises:
      ValueError: if usd-core is missing, or the model has a number that is not finite or too large.
    """
    path = checked_path(path, "save_usd")
    stage = _stage_of(checked_live(model), ellipsoids)
    # usd-core chooses the format by the suffix, which the temporary path lacks.
    with replacing(path) as temporary, tempfile.TemporaryDirectory(dir=path.parent) as folder:
        suffix = path.suffix.lower() if path.suffix.lower() in (".usda", ".usdz") else ".usdc"
        layer = Path(folder, f"splats{'.usdc' if suffix == '.usdz' else suffix}")
        written = stage.GetRootLayer().Export(str(layer))
        if written and suffix == ".usdz":
            written = import_usd().UsdUtils.CreateNewUsdzPackage(str(layer), str(layer.with_suffix(suffix)))
        if not written:
            raise ValueError(f"{path}: usd-core could not write the file")
        shutil.move(layer.with_suffix(suffix), temporary)


def import_usd() -> Any:
    """Return the modules of usd-core. ValueError, with what to install, if it is missing or too old."""
    try:
        # Subpackages must be imported to become attributes of pxr.
        import pxr
        from pxr import Gf, Usd, UsdGeom, UsdUtils, UsdVol, Vt  # noqa: F401 - as attributes of the package

        # Particle fields came with 26.03.
        if not hasattr(UsdVol, SURFLET):
            raise ImportError("it is older than 26.03")
    except ImportError as error:
        raise ValueError(f"OpenUSD files need usd-core ({error}): pip install 'a2tg-jax[usd]'") from error
    return pxr


def _stage_of(model: Model, ellipsoids: bool) -> Any:
    """Return a stage of one particle field."""
    usd = import_usd()
    splats = splats_of(model)
    stage = usd.Usd.Stage.CreateInMemory()
    usd.UsdGeom.SetStageUpAxis(stage, usd.UsdGeom.Tokens.z)
    # USD's default is centimetres.
    usd.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    world = usd.UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    kind = usd.UsdVol.ParticleField3DGaussianSplat if ellipsoids else usd.UsdVol.ParticleField
    field = kind.Define(stage, "/World/Splats")
    prim = field.GetPrim()
    if not ellipsoids:
        for name in ATTRIBUTES:
            getattr(usd.UsdVol, f"ParticleField{name}AttributeAPI").Apply(prim)
        getattr(usd.UsdVol, SURFLET).Apply(prim)
    matrix = matrix_of(upright(model.origin, "z"))
    # USD's matrices are for row vectors.
    field.AddTransformOp().Set(usd.Gf.Matrix4d(*matrix.T.ravel().tolist()))
    volume = usd.UsdVol
    arrays = usd.Vt
    harmonics = volume.ParticleFieldSphericalHarmonicsAttributeAPI(prim)
    xyzw = splats.quats[:, [1, 2, 3, 0]]
    numbers = (
        (volume.ParticleFieldPositionAttributeAPI(prim).CreatePositionsAttr(), arrays.Vec3fArray, splats.means),
        (volume.ParticleFieldOrientationAttributeAPI(prim).CreateOrientationsAttr(), arrays.QuatfArray, xyzw),
        (volume.ParticleFieldScaleAttributeAPI(prim).CreateScalesAttr(), arrays.Vec3fArray, splats.scales),
        (volume.ParticleFieldOpacityAttributeAPI(prim).CreateOpacitiesAttr(), arrays.FloatArray, splats.opacities),
        # Coefficients go particle by particle.
        (harmonics.CreateRadianceSphericalHarmonicsCoefficientsAttr(), arrays.Vec3fArray, splats.sh.reshape(-1, 3)),
    )
    for attribute, array, values in numbers:
        attribute.Set(array.FromNumpy(np.ascontiguousarray(values)))
    harmonics.CreateRadianceSphericalHarmonicsDegreeAttr(NUM_BASES.index(splats.sh.shape[1]))
    if model.num:
        # Extents contain splats up to three standard deviations.
        reach = 3 * splats.scales.max(axis=1, keepdims=True)
        corners = np.stack([(splats.means - reach).min(axis=0), (splats.means + reach).max(axis=0)])
        field.CreateExtentAttr(usd.Vt.Vec3fArray.FromNumpy(corners))
    kept = {} if model.origin is None else origin_to_json(model.origin)
    if kept or any(model.background):
        kept |= {"background": list(model.background)}
        prim.SetCustomDataByKey(ORIGIN, json.dumps(kept, allow_nan=False))
    return stage


def load_usd(path: str | os.PathLike[str]) -> Model:
    """Return the model of the particle fields of an OpenUSD file, float32, of this program or another.

    Files of `save_usd` restore the origin and the model's world. Fields of other programs are rotated so that +z is up,
    in metres. The thinnest axis of an ellipsoid becomes its normal, with a warning if that changes much.

    Args:
      path: the file, *.usd, *.usda, *.usdc or *.usdz.

    Returns:
      The model, float32.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if usd-core is missing, or the file is not USD, is damaged, or holds no splats.
    """
    path = checked_path(path, "load_usd")
    import_usd()
    check_exists(path, "USD file")
    # usd-core opens the path itself: this checks the size and the permission first.
    open_regular(path, MOST_ARRAY_BYTES).close()
    with reading(path):
        described, arrays = _read_apart(path)
        return joined_parts(_parts(described, arrays, path), "z" if described["is_z_up"] else "y")


def _parts(
    described: Mapping[str, Any], arrays: Mapping[str, np.ndarray], path: Path
) -> Iterator[tuple[Model, np.ndarray]]:
    """Yield the model of each particle field, and the matrix from its world to the stage's, in metres."""
    to_metres = np.diag([*[described["unit"]] * 3, 1.0])
    for index, field in enumerate(described["fields"]):
        yield _model_of(field, arrays, f"{index}:", path), to_metres @ np.reshape(field["matrix"], (4, 4))


def _read_apart(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what `usd_fields` reads from a file, in a process that a damaged file may end."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "fields.npz")
        command = [sys.executable, "-P", usd_fields.__file__, str(path.absolute()), str(out), ORIGIN]
        # Packages may be in places that only this process knows.
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        done = subprocess.run(command, env=environment, capture_output=True, check=False)
        if done.returncode:
            reason = done.stderr.decode(errors="replace")
            # usd-core names lines of its own sources before each reason.
            reason = "; ".join(re.findall(r" in file \S+ : '(.*)'$", reason, re.MULTILINE)) or reason
            if done.returncode != usd_fields.REFUSED:
                reason = f"usd-core ended with status {done.returncode}"
            raise ValueError(f"is not a USD file, or is damaged ({shortened(' '.join(reason.split()))})")
        arrays = read_npz(out)
    return parse_json(arrays.pop("described").tobytes(), allow_nan=True), arrays


def _model_of(field: Mapping[str, Any], arrays: Mapping[str, np.ndarray], prefix: str, path: Path) -> Model:
    """Return the model of a particle field, in the field's own world."""
    kernels = {*field["schemas"]} & {SURFLET, ELLIPSOID}
    if len(kernels) != 1:
        raise ValueError(f"its particle field {shortened(field['path'])} must have a kernel of Gaussians")
    # Missing attributes have the schema's defaults.
    means = arrays.get(f"{prefix}positions", np.zeros((0, 3), np.float32))
    num = len(means)
    degree = field["degree"]
    if f"{prefix}sh" in arrays:
        sh = arrays[f"{prefix}sh"].reshape(num, (degree + 1) ** 2, 3)
        sh = sh[:, : NUM_BASES[degree_to_read(degree, str(path))]]
    else:
        sh = np.zeros((num, 1, 3), np.float32)

    def column(name: str, default: tuple[float, ...]) -> np.ndarray:
        return arrays.get(prefix + name, np.tile(np.asarray(default, np.float32), (num, 1)))

    # Quatf arrays become xyzw in NumPy.
    quats = column("orientations", (0.0, 0.0, 0.0, 1.0))[:, [3, 0, 1, 2]]
    scales = column("scales", (1.0, 1.0, 1.0))
    opacities = column("opacities", (1.0,))[:, 0]
    splats = Ellipsoids(means, quats, scales, opacities, sh)
    kept = {"background": (0.0, 0.0, 0.0)} if field["origin"] is None else parse_json(field["origin"])
    # A model without an origin has a background alone.
    origin = None if set(kept) == {"background"} else origin_of(kept, kept)
    is_flat = SURFLET in kernels
    return model_of_splats(splats, path, is_flat=is_flat, background=background_of(kept), origin=origin)
