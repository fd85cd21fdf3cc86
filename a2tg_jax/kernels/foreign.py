"""Functions on numpy arrays that XLA calls on the CPU, through its foreign function interface (xla/ffi/api/c_api.h)."""

import ctypes
import hashlib
import sys
import threading
from collections.abc import Callable, Hashable

import jax
import numpy as np

Handler = Callable[[list[np.ndarray], list[np.ndarray]], None]
"""Reads the arguments and fills the results, all of them views of XLA's buffers."""

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
_entries: dict[str, tuple[Hashable, object]] = {}


def registered(description: str, key: Hashable, make_handler: Callable[[], Handler]) -> str:
    """The name by which `jax.ffi.ffi_call` calls, on the CPU, the handler for a key.

    It is the same in every process for the same description, for XLA's compilation cache; but where another key has the
    same description, such as a function that was defined anew, it is another one.
    """
    name = f"a2tg_{hashlib.sha256(description.encode()).hexdigest()[:20]}"
    with _LOCK:
        while name in _entries and _entries[name][0] != key:
            name += "_"
        if name not in _entries:
            handler = make_handler()
            entry = _Entry(lambda frame: _enter(frame.contents, handler))
            _entries[name] = key, entry
            address = ctypes.cast(entry, ctypes.c_void_p).value
            jax.ffi.register_ffi_target(name, _capsule(address), platform="cpu")
    return name


def _capsule(address: int | None):
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, (_pointer, ctypes.c_char_p, _pointer)
    return new(address, None, None)


def _enter(frame: _CallFrame, handler: Handler) -> int | None:
    """One call by XLA: None where it went well, else the address of an error."""
    extension = frame.extension
    if extension and extension.contents.kind == METADATA_EXTENSION:
        version, own = extension.contents.metadata.contents.version, frame.api.contents.version
        version.major, version.minor = own.major, own.minor
        return None
    if frame.stage != EXECUTE_STAGE:
        return None
    try:
        handler(_arrays(frame.arguments), _arrays(frame.results))
    except BaseException as error:  # nothing may pass through C: XLA is told instead
        sys.excepthook(type(error), error, error.__traceback__)
        message = f"{type(error).__name__}: {error}".encode()
        arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message, INTERNAL_ERROR)
        return frame.api.contents.create_error(ctypes.byref(arguments))
    return None


def _arrays(buffers: _Buffers) -> list[np.ndarray]:
    return [_array(buffers.buffers[index].contents) for index in range(buffers.num)]


def _array(buffer: _Buffer) -> np.ndarray:
    shape, dtype = tuple(buffer.dims[: buffer.rank]), np.dtype(DTYPES[buffer.dtype])
    num_bytes = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    if num_bytes == 0:
        return np.empty(shape, dtype)
    memory = (ctypes.c_ubyte * num_bytes).from_address(buffer.data)
    return np.frombuffer(memoryview(memory), dtype).reshape(shape)
