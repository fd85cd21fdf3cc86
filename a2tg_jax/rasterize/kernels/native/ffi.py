"""Functions on numpy arrays that XLA calls on the CPU, through its foreign function interface (xla/ffi/api/c_api.h)."""

import contextlib
import ctypes
import hashlib
import signal
import threading
import traceback
from collections.abc import Callable, Hashable, Iterator

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
_AT_THE_END = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, b"the program is ending", INTERNAL_ERROR)
ctypes.pythonapi.Py_IncRef(ctypes.py_object(_AT_THE_END))  # used as long as the process lives
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
            entry = _Entry(_entry(make_handler()))
            _entries[name] = key, entry
            jax.ffi.register_ffi_target(name, _capsule(_gated(entry)), platform="cpu")
    return name


def _capsule(address: int | None, destructor: int | None = None):
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, (_pointer, ctypes.c_char_p, _pointer)
    return new(address, None, destructor)


def _gated(entry) -> int:
    """The address of an entry behind the gate that the end of the program closes."""
    from a2tg_jax.rasterize.kernels.native import gate

    address = ctypes.cast(entry, _pointer).value or 0
    path = _CallFrame.api.offset, _Api.create_error.offset
    return gate.gated(address, path, ctypes.addressof(_AT_THE_END))


def _entry(handler: Handler) -> Callable[..., int | None]:
    """What XLA calls: it returns None where all went well, else the address of an error.

    Nothing may be raised through C: it would be lost, and what the results happened to hold would count as computed.
    """

    def enter(frame) -> int | None:
        interrupts: list[int] = []
        dropped_last = []
        try:
            with _interrupts_noted(interrupts):
                _call(frame.contents, handler)
            if interrupts:
                dropped_last.append(_interrupt_once_dropped())
        except BaseException as error:
            if interrupts or isinstance(error, KeyboardInterrupt):
                dropped_last.append(_interrupt_once_dropped())
            failure = _failure(frame.contents, error)
            error.with_traceback(None)  # it would keep the variables of this function
            return failure
        return None

    return enter


@contextlib.contextmanager
def _interrupts_noted(interrupts: list[int]) -> Iterator[None]:
    """Ctrl-C does not stop what runs here on the main thread, the only one that signals reach; it is appended."""
    before = signal.getsignal(signal.SIGINT)
    if threading.get_ident() != threading.main_thread().ident or not callable(before):
        yield
        return
    signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _interrupt_once_dropped():
    """An object whose end is a Ctrl-C, which the main thread meets in Python's next step: with the last reference in
    the variables of a function that XLA calls, only when that has returned."""
    interrupt = ctypes.cast(ctypes.pythonapi.PyErr_SetInterrupt, _pointer).value
    return _capsule(interrupt, interrupt)


def _call(frame: _CallFrame, handler: Handler) -> None:
    extension = frame.extension
    if extension and extension.contents.kind == METADATA_EXTENSION:
        version, own = extension.contents.metadata.contents.version, frame.api.contents.version
        version.major, version.minor = own.major, own.minor
    elif frame.stage == EXECUTE_STAGE:
        handler(_arrays(frame.arguments), _arrays(frame.results))


def _failure(frame: _CallFrame, error: BaseException) -> int:
    """XLA's error that says what was raised, and where."""
    what = "".join(traceback.format_exception_only(error))
    where = "".join(traceback.format_tb(error.__traceback__)[2:])
    message = f"{what}raised, most recent call last, at\n{where}".encode(errors="replace")
    arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message, INTERNAL_ERROR)
    return frame.api.contents.create_error(ctypes.byref(arguments))


def _arrays(buffers: _Buffers) -> list[np.ndarray]:
    return [_array(buffers.buffers[index].contents) for index in range(buffers.num)]


def _array(buffer: _Buffer) -> np.ndarray:
    shape, dtype = tuple(buffer.dims[: buffer.rank]), np.dtype(DTYPES[buffer.dtype])
    num_bytes = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    if num_bytes == 0:
        return np.empty(shape, dtype)
    memory = (ctypes.c_ubyte * num_bytes).from_address(buffer.data)
    return np.frombuffer(memoryview(memory), dtype).reshape(shape)
