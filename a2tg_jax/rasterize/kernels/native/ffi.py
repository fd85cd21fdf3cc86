"""Functions on numpy arrays that XLA calls on CPUs, through its foreign function interface (xla/ffi/api/c_api.h)."""

import contextlib
import ctypes
import hashlib
import re
import signal
import threading
import traceback
from collections.abc import Callable, Hashable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array
from jax.typing import DTypeLike

Handler = Callable[[list[np.ndarray], list[np.ndarray]], None]
"""Function of arguments and results, views of XLA's buffers: it reads the arguments and fills the results."""

VERSION = 0, 3
"""Version of the interface, major and minor, from which the structures below were copied."""
METADATA_EXTENSION = 1
EXECUTE_STAGE = 3
INTERNAL_ERROR = 13
DTYPES = {1: np.bool_, 4: np.int32, 5: np.int64, 8: np.uint32, 11: np.float32, 12: np.float64}

_pointer, _size, _int = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int


class _Version(ctypes.Structure):
    _fields_ = (("struct_size", _size), ("extension", _pointer), ("major", _int), ("minor", _int))


class _Metadata(ctypes.Structure):
    _fields_ = (("struct_size", _size), ("version", _Version), ("traits", ctypes.c_uint32))


class _Extension(ctypes.Structure):
    _fields_ = (("struct_size", _size), ("kind", _int), ("next", _pointer), ("metadata", ctypes.POINTER(_Metadata)))


class _ErrorArguments(ctypes.Structure):
    _fields_ = (("struct_size", _size), ("extension", _pointer), ("message", ctypes.c_char_p), ("code", _int))


class _Api(ctypes.Structure):
    _fields_ = (
        ("struct_size", _size),
        ("extension", _pointer),
        ("version", _Version),
        ("internal", _pointer),
        ("create_error", ctypes.CFUNCTYPE(_pointer, ctypes.POINTER(_ErrorArguments))),
    )


class _Buffer(ctypes.Structure):
    _fields_ = (
        ("struct_size", _size),
        ("extension", _pointer),
        ("dtype", _int),
        ("data", _pointer),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    )


class _Buffers(ctypes.Structure):
    _fields_ = (
        ("struct_size", _size),
        ("extension", _pointer),
        ("num", ctypes.c_int64),
        ("kinds", _pointer),
        ("buffers", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    )


class _CallFrame(ctypes.Structure):
    _fields_ = (
        ("struct_size", _size),
        ("extension", ctypes.POINTER(_Extension)),
        ("api", ctypes.POINTER(_Api)),
        ("context", _pointer),
        ("stage", _int),
        ("arguments", _Buffers),
        ("results", _Buffers),
    )


_Entry = ctypes.CFUNCTYPE(_pointer, ctypes.POINTER(_CallFrame))
_LOCK = threading.RLock()
_AT_THE_END = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, b"the program is ending", INTERNAL_ERROR)
ctypes.pythonapi.Py_IncRef(ctypes.py_object(_AT_THE_END))  # in use as long as the process lives
_entries: dict[str, tuple[Hashable, object]] = {}


def installed_version() -> tuple[int, int] | None:
    """Return the version of the interface in the headers that jaxlib brings; None if it brings none."""
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    if not header.is_file():
        return None
    numbers = dict(re.findall(r"#define XLA_FFI_API_(MAJOR|MINOR) (\d+)", header.read_text(encoding="utf-8")))
    return int(numbers["MAJOR"]), int(numbers["MINOR"])


def refusal() -> str | None:
    """Return why functions cannot be registered with this jaxlib; None if they can.

    XLA keeps old minor versions working for a year, but no old major ones.
    """
    found = installed_version()
    if found is None or (found[0] == VERSION[0] and found >= VERSION):
        return None
    own, other = (".".join(map(str, version)) for version in (VERSION, found))
    return f"native loops speak version {own} of XLA's foreign function interface, and this jaxlib {other}"


def registered(description: str, key: Hashable, make_handler: Callable[[], Handler]) -> str:
    """Return the name by which `call` reaches the handler for a key; make and register the handler if there is none.

    The same description gives the same name in every process, for XLA's compilation cache. If another key already has
    that description, such as a function that was defined again, the name differs.
    """
    name = f"a2tg_{hashlib.sha256(description.encode()).hexdigest()[:20]}"
    with _LOCK:
        while name in _entries and _entries[name][0] != key:
            name += "_"
        if name not in _entries:
            entry = _Entry(_entry(make_handler()))
            _entries[name] = key, entry
            jax.ffi.register_ffi_target(name, _capsule(_gated(entry)), platform="cpu")
    return name


def call(name: str, results: Sequence[tuple[tuple[int, ...], DTypeLike]], *inputs: Array) -> list[Array]:
    """Call a registered handler inside a computation.

    Args:
      name: name from `registered`.
      results: shape and dtype of each result.
      inputs: arguments of the handler.
    """
    shapes = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in results]
    return list(jax.ffi.ffi_call(name, shapes, vmap_method="sequential")(*inputs))


def _capsule(address: int | None, destructor: int | None = None) -> object:
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, (_pointer, ctypes.c_char_p, _pointer)
    capsule: object = new(address, None, destructor)
    return capsule


def _gated(entry: Any) -> int:
    """Return the address of an entry behind the gate, which closes when the program ends."""
    from a2tg_jax.rasterize.kernels.native import shutdown_gate

    address = ctypes.cast(entry, _pointer).value or 0
    path = _CallFrame.api.offset, _Api.create_error.offset
    return shutdown_gate.gated(address, path, ctypes.addressof(_AT_THE_END))


def _entry(handler: Handler) -> Callable[..., int | None]:
    """Return the function that XLA calls; it returns None on success, else the address of an error.

    No exception may pass through C: it would be lost, and the unfilled results would count as computed.
    """

    def enter(frame: Any) -> int | None:
        interrupts: list[int] = []
        dropped_last: list[object] = []
        try:
            with _interrupts_noted(interrupts):
                _dispatch(frame.contents, handler)
            if interrupts:
                dropped_last.append(_interrupt_once_dropped())
        except BaseException as error:
            if interrupts or isinstance(error, KeyboardInterrupt):
                dropped_last.append(_interrupt_once_dropped())
            failure = _failure(frame.contents, error)
            error.with_traceback(None)  # a traceback would keep this function's variables alive
            return failure
        return None

    return enter


@contextlib.contextmanager
def _interrupts_noted(interrupts: list[int]) -> Iterator[None]:
    """Append Ctrl-C to a list instead of raising it, on the main thread, the only one that signals reach."""
    before = signal.getsignal(signal.SIGINT)
    if threading.get_ident() != threading.main_thread().ident or not callable(before):
        yield
        return
    signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _interrupt_once_dropped() -> object:
    """Return an object that raises Ctrl-C in the main thread once it is deleted.

    If a variable of a function that XLA calls holds the last reference, that is after the function has returned.
    """
    interrupt = ctypes.cast(ctypes.pythonapi.PyErr_SetInterrupt, _pointer).value
    return _capsule(interrupt, interrupt)


def _dispatch(frame: _CallFrame, handler: Handler) -> None:
    """Answer XLA's question for metadata, or execute the handler."""
    extension = frame.extension
    if extension and extension.contents.kind == METADATA_EXTENSION:
        version = extension.contents.metadata.contents.version
        version.major, version.minor = VERSION
    elif frame.stage == EXECUTE_STAGE:
        handler(_arrays(frame.arguments), _arrays(frame.results))


def _failure(frame: _CallFrame, error: BaseException) -> int:
    """Make XLA's error, with the exception and its traceback; return its address."""
    what = "".join(traceback.format_exception_only(error))
    where = "".join(traceback.format_tb(error.__traceback__)[2:])
    message = f"{what}raised, most recent call last, at\n{where}".encode(errors="replace")
    arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message, INTERNAL_ERROR)
    address: int = frame.api.contents.create_error(ctypes.byref(arguments))
    return address


def _arrays(buffers: _Buffers) -> list[np.ndarray]:
    return [_array(buffers.buffers[index].contents) for index in range(buffers.num)]


def _array(buffer: _Buffer) -> np.ndarray:
    shape, dtype = tuple(buffer.dims[: buffer.rank]), np.dtype(DTYPES[buffer.dtype])
    num_bytes = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    if num_bytes == 0:
        return np.empty(shape, dtype)
    memory = (ctypes.c_ubyte * num_bytes).from_address(buffer.data)
    return np.frombuffer(memoryview(memory), dtype).reshape(shape)
