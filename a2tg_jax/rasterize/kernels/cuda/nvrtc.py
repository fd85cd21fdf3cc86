"""PTX from CUDA C++ by NVRTC, which `jax[cuda13]` brings. It needs no GPU, no driver and no compiler."""

import ctypes
import functools
import importlib.util
import re
from pathlib import Path

LEAST_ISA = {7: "8.1", 8: "8.1", 9: "8.1", 10: "8.8", 12: "8.8"}
"""PTX version that the kernels need, by the major compute capability: 8.1 brought atomic sums of four floats."""


class CompilationError(RuntimeError):
    """NVRTC refused a kernel; the message has its log."""


def find() -> Path | None:
    """Return the path of NVRTC's library, or None if no package brings it."""
    for package in ("nvidia.cu13", "nvidia.cuda_nvrtc", "nvidia.cu12"):
        try:
            spec = importlib.util.find_spec(package)
        except ModuleNotFoundError:
            continue
        for folder in (spec and spec.submodule_search_locations) or ():
            for path in sorted(Path(folder).rglob("*nvrtc*.so*")) + sorted(Path(folder).rglob("nvrtc64_*.dll")):
                if "builtins" not in path.name and "alt" not in path.name:
                    return path
    return None


@functools.cache
def _library() -> ctypes.CDLL:
    path = find()
    if path is None:
        raise ModuleNotFoundError(
            "GPU kernels need NVRTC, which is not installed: pip install 'a2tg-jax[cuda13]', or [cuda12]"
        )
    # NVRTC opens its builtins by name, and does not look for them in its own folder.
    for builtins in sorted(path.parent.glob("*nvrtc-builtins*")):
        ctypes.CDLL(str(builtins), mode=getattr(ctypes, "RTLD_GLOBAL", 0))
    return ctypes.CDLL(str(path))


@functools.cache
def ptx(source: str, capability: str) -> str:
    """Compile CUDA C++ to PTX for a compute capability, such as "9.0".

    Raises:
      CompilationError: with NVRTC's log.
      ModuleNotFoundError: if NVRTC is not installed.
    """
    library = _library()
    program = ctypes.c_void_p()
    _check(library.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"tiles.cu", 0, None, None))
    try:
        # Divisions of floats to two units in the last place: exact ones need a fifth of the registers, and branches.
        options = [f"--gpu-architecture=compute_{capability.replace('.', '')}", "--std=c++17", "--prec-div=false"]
        array = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
        if library.nvrtcCompileProgram(program, len(options), array):
            raise CompilationError(f"NVRTC refused a kernel:\n{_text(program, 'ProgramLog')}")
        text = _text(program, "PTX")
        least = LEAST_ISA.get(int(capability.split(".")[0]))
        # A hint that needs version 8.3: bytes of a load that are not used.
        text = re.sub(r'\.pragma "used_bytes_mask[^;]*;', "", text)
        # The version that the kernels need instead of NVRTC's own, which a driver refuses if it is older.
        declared = r"\g<0>" if least is None else f".version {least}"
        return re.sub(r"^\.version \S+", declared, text, count=1, flags=re.MULTILINE)
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))


def _text(program: ctypes.c_void_p, what: str) -> str:
    size = ctypes.c_size_t()
    _check(getattr(_library(), f"nvrtcGet{what}Size")(program, ctypes.byref(size)))
    text = ctypes.create_string_buffer(size.value)
    _check(getattr(_library(), f"nvrtcGet{what}")(program, text))
    return text.value.decode()


def _check(code: int) -> None:
    if code:
        _library().nvrtcGetErrorString.restype = ctypes.c_char_p
        raise CompilationError(f"NVRTC failed: {_library().nvrtcGetErrorString(code).decode()}")
