"""The copied structures of XLA's foreign function interface are those of the headers that jaxlib brings."""

import ctypes
import shutil
import subprocess

import jax
import numpy as np
import pytest

from a2tg_jax.rasterize.kernels.native import ffi

C_NAMES = {np.bool_: "PRED", np.int32: "S32", np.int64: "S64", np.uint32: "U32", np.float32: "F32", np.float64: "F64"}
CONSTANTS = {
    "XLA_FFI_API_MAJOR": ffi.VERSION[0],
    "XLA_FFI_Extension_Metadata": ffi.METADATA_EXTENSION,
    "XLA_FFI_ExecutionStage_EXECUTE": ffi.EXECUTE_STAGE,
    "XLA_FFI_Error_Code_INTERNAL": ffi.INTERNAL_ERROR,
    **{f"XLA_FFI_DataType_{C_NAMES[dtype]}": number for number, dtype in ffi.DTYPES.items()},
}


@pytest.fixture(scope="module")
def of_headers(tmp_path_factory) -> dict[str, int]:
    """Offset and size of each field, and each constant, as a C compiler reads them in jaxlib's headers."""
    compiler = shutil.which("cc")
    if compiler is None or ffi.installed_version() is None:
        pytest.skip("needs a C compiler as cc, and the headers of jaxlib")
    lines = [f'printf("{name} %lld\\n", (long long){name});' for name in CONSTANTS]
    for struct, ours in ffi.STRUCTURES.items():
        for field, _ in ours._fields_:
            numbers = f"offsetof(struct {struct}, {field}), sizeof(((struct {struct}*)0)->{field})"
            lines.append(f'printf("{struct}.{field} %zu\\n{struct}.{field}:size %zu\\n", {numbers});')
    folder = tmp_path_factory.mktemp("headers")
    source = folder / "sizes.c"
    program = folder / "sizes"
    text = ["#include <stdio.h>", '#include "xla/ffi/api/c_api.h"', "int main(void) {", *lines, "return 0; }"]
    source.write_text("\n".join(text))
    subprocess.run([compiler, "-I", jax.ffi.include_dir(), "-o", program, source], check=True)
    printed = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    return {name: int(number) for name, number in (line.split() for line in printed.splitlines())}


@pytest.mark.parametrize("struct", ffi.STRUCTURES)
def test_fields_lie_where_the_headers_have_them(of_headers, struct):
    ours = ffi.STRUCTURES[struct]
    for field, kind in ours._fields_:
        place = getattr(ours, field).offset, ctypes.sizeof(kind)
        assert place == (of_headers[f"{struct}.{field}"], of_headers[f"{struct}.{field}:size"]), field


@pytest.mark.parametrize("name", CONSTANTS)
def test_constants_are_those_of_the_headers(of_headers, name):
    assert of_headers[name] == CONSTANTS[name]
