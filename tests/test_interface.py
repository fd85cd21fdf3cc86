"""The copied structures of XLA's foreign function interface are those of the headers that jaxlib brings."""

import ctypes
import shutil
import subprocess

import jax
import numpy as np
import pytest

from a2tg_jax.rasterize.kernels.native import ffi

FIELDS = {
    ffi._Version: ("XLA_FFI_Api_Version", "struct_size extension_start major_version minor_version"),
    ffi._Metadata: ("XLA_FFI_Metadata", "struct_size api_version traits"),
    ffi._Extension: (
        "XLA_FFI_Metadata_Extension",
        "extension_base.struct_size extension_base.type extension_base.next metadata",
    ),
    ffi._ErrorArguments: ("XLA_FFI_Error_Create_Args", "struct_size extension_start message errc"),
    ffi._Api: ("XLA_FFI_Api", "struct_size extension_start api_version internal_api XLA_FFI_Error_Create"),
    ffi._Buffer: ("XLA_FFI_Buffer", "struct_size extension_start dtype data rank dims"),
    ffi._Buffers: ("XLA_FFI_Args", "struct_size extension_start size types args"),
    ffi._CallFrame: ("XLA_FFI_CallFrame", "struct_size extension_start api ctx stage args rets"),
}
"""The headers' name of each structure, and of its fields in the order of ours."""
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
    for struct, fields in FIELDS.values():
        for field in fields.split():
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


@pytest.mark.parametrize("own", FIELDS, ids=lambda own: own.__name__.strip("_"))
def test_fields_lie_where_the_headers_have_them(of_headers, own):
    struct, fields = FIELDS[own]
    for (name, kind), field in zip(own._fields_, fields.split(), strict=True):
        found = getattr(own, name).offset, ctypes.sizeof(kind)
        assert found == (of_headers[f"{struct}.{field}"], of_headers[f"{struct}.{field}:size"]), name


@pytest.mark.parametrize("name", CONSTANTS)
def test_constants_are_those_of_the_headers(of_headers, name):
    assert of_headers[name] == CONSTANTS[name]
