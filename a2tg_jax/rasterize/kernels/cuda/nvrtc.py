"""PTX from CUDA C++ by NVRTC, which `jax[cuda13]` brings. It needs no GPU, no driver and no compiler."""

import ctypes
import functools
import importlib.util
import re
from pathlib import Path

OPTIONS = ("--std=c++17",)
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
    # NVRTC opens its builtins by name, and does not look beside itself for them.
    for builtins in sorted(path.parent.glob("*nvrtc-builtins*")):
        ctypes.CDLL(str(builtins), mode=getattr(ctypes, "RTLD_GLOBAL", 0))
    return ctypes.CDLL(str(path))


@functools.cache
def ptx(source: str, capability: str) -> str:
    """Compile CUDA C++ to PTX.

    Args:
      source: the text; its kernels are `extern "C"`.
      capability: compute capability of the GPU, such as "9.0".

    Raises:
      CompilationError: with NVRTC's log.
      ModuleNotFoundError: if NVRTC is not installed.
    """
    library, program = _library(), ctypes.c_void_p()
    _check(library.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"tiles.cu", 0, None, None))
    try:
        options = [f"--gpu-architecture=compute_{capability.replace('.', '')}", *OPTIONS]
        array = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
        if library.nvrtcCompileProgram(program, len(options), array):
            raise CompilationError(f"NVRTC refused a kernel:\n{_text(program, 'ProgramLog')}")
        return _declared(_text(program, "PTX"), capability)
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))


def _declared(text: str, capability: str) -> str:
    """Declare the PTX version that the kernels need, not NVRTC's own: a driver refuses versions newer than itself.

    The version stays NVRTC's own for capabilities that are not known here.
    """
    least = LEAST_ISA.get(int(capability.split(".")[0]))
    return text if least is None else re.sub(r"^\.version \S+", f".version {least}", text, count=1, flags=re.MULTILINE)


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
