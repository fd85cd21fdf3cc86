"""Program that reads the particle fields of an OpenUSD file, `python usd_fields.py FILE OUT.npz`, for `load_usd`.

A damaged file can end the process of usd-core (26.11 does so for one changed *.usdc in a thousand), so usd-core runs in
a separate process, with NumPy and without this package. OUT has the arrays of each field and, as JSON in bytes, the
rest. Errors go to the standard error, with status 3.
"""

import json
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

REFUSED = 3
"""Status of the program if usd-core refuses the file."""
COLUMNS = {"orientations": 4, "scales": 3, "opacities": 1}
"""Columns of the attributes of which each particle has one row, besides its position."""
DEGREE = "radiance:sphericalHarmonicsDegree"
COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"


def main(file: str, out: str, origin: str) -> None:
    """Read a file; `origin` is the key of custom data that are kept."""
    from pxr import Usd, UsdGeom, UsdVol

    stage = Usd.Stage.Open(file)
    fields: list[dict[str, Any]] = []
    arrays: dict[str, Any] = {}
    for prim in stage.Traverse():
        if not prim.IsA(UsdVol.ParticleField):
            continue
        time = Usd.TimeCode.EarliestTime()
        degree = int(prim.GetAttribute(DEGREE).Get(time))
        arrays |= {f"{len(fields)}:{name}": values for name, values in _arrays(prim, time, degree)}
        matrix = UsdVol.ParticleField(prim).ComputeLocalToWorldTransform(time)
        kept = prim.GetCustomDataByKey(origin)
        fields.append(
            {
                "path": str(prim.GetPath()), "schemas": [str(schema) for schema in prim.GetAppliedSchemas()],
                "degree": degree, "matrix": np.array(matrix, np.float64).T.ravel().tolist(),
                "origin": kept if isinstance(kept, str) else None,
            }
        )  # fmt: skip
    is_z_up = UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    described = {"is_z_up": is_z_up, "unit": float(UsdGeom.GetStageMetersPerUnit(stage)), "fields": fields}
    np.savez(out, described=np.frombuffer(json.dumps(described).encode(), np.uint8), **arrays)


def _arrays(prim: Any, time: Any, degree: int) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and the rows of each attribute of a field that is there. Ones that are too long are cut."""
    means = _rows(prim, time, "positions", 3)
    num = 0 if means is None else len(means)
    if means is not None:
        yield "positions", means
    for name, columns in COLUMNS.items():
        values = _rows(prim, time, name, columns, num)
        if values is not None:
            yield name, values
    sh = _rows(prim, time, COEFFICIENTS, 3, num * (degree + 1) ** 2)
    if sh is not None:
        yield "sh", sh


def _rows(prim: Any, time: Any, name: str, columns: int, wanted: int | None = None) -> np.ndarray | None:
    """Return the first `wanted` rows [n, columns] of an attribute of floats, else halves; None if it is missing."""
    # The schema's half attributes end in h; floats win if both are authored.
    for attribute in (prim.GetAttribute(name), prim.GetAttribute(f"{name}h")):
        values = attribute.Get(time) if attribute else None
        if values is not None and len(values) >= (wanted or 0):
            return np.asarray(values).reshape(-1, columns)[:wanted].astype(np.float32)
    return None


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (RuntimeError, TypeError, ValueError) as error:  # RuntimeError: usd-core's errors.
        print(str(error), file=sys.stderr)
        sys.exit(REFUSED)
