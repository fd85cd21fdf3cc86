"""Functions on numpy arrays that XLA calls on CPUs, through its foreign function interface (xla/ffi/api/c_api.h).

Handlers divide their work among threads (`run_spans`). Under `vmap`, one call computes the whole batch: threads divide
its members.

XLA may still compute on its own threads when a program ends. A thread that then waits for Python's GIL never gets it:
the program crashes or hangs. So these threads pass a gate in native code, which closes at the end. Threads that come
later return with an error, and the end waits for the ones inside. Daemon threads of Python that wait for arrays in
native code are in the same danger: the program ends once XLA has computed their arrays, or met the error.
"""

import atexit
import concurrent.futures
import contextlib
import ctypes
import functools
import hashlib
import itertools
import math
import os
import re
import signal
import threading
import time
import traceback
from collections.abc import Callable, Hashable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from a2tg_jax.base import threads
from a2tg_jax.rasterize.kernels.native import llvm_code

Handler = Callable[[list[np.ndarray], list[np.ndarray]], None]
"""Function of arguments and results, views of XLA's buffers: it reads the arguments and fills the results."""

Span = tuple[int, int]
"""First item, and the end, which is excluded."""

VERSION = 0, 3
"""Version of the interface, major and minor, from which the structures below were copied."""
METADATA_EXTENSION = 1
EXECUTE_STAGE = 3
INTERNAL_ERROR = 13
DTYPES = {1: np.bool_, 4: np.int32, 5: np.int64, 8: np.uint32, 11: np.float32, 12: np.float64}

_pointer = ctypes.c_void_p
_size = ctypes.c_size_t
_int = ctypes.c_int


STRUCTURES: dict[str, Any] = {}
"""Structures by the names that the header gives them and their fields."""


def _structure(name: str, **fields: Any) -> Any:
    STRUCTURES[name] = type(name, (ctypes.Structure,), {"_fields_": tuple(fields.items())})
    return STRUCTURES[name]


_Version = _structure(
    "XLA_FFI_Api_Version", struct_size=_size, extension_start=_pointer, major_version=_int, minor_version=_int
)
_Metadata = _structure("XLA_FFI_Metadata", struct_size=_size, api_version=_Version, traits=ctypes.c_uint32)
_ExtensionBase = _structure("XLA_FFI_Extension_Base", struct_size=_size, type=_int, next=_pointer)
_Extension = _structure("XLA_FFI_Metadata_Extension", extension_base=_ExtensionBase, metadata=ctypes.POINTER(_Metadata))
_ErrorArguments = _structure(
    "XLA_FFI_Error_Create_Args", struct_size=_size, extension_start=_pointer, message=ctypes.c_char_p, errc=_int
)
_CreateError = ctypes.CFUNCTYPE(_pointer, ctypes.POINTER(_ErrorArguments))
_Api = _structure(
    "XLA_FFI_Api", struct_size=_size, extension_start=_pointer, api_version=_Version, internal_api=_pointer,
    XLA_FFI_Error_Create=_CreateError,
)  # fmt: skip
_Buffer = _structure(
    "XLA_FFI_Buffer", struct_size=_size, extension_start=_pointer, dtype=_int, data=_pointer, rank=ctypes.c_int64,
    dims=ctypes.POINTER(ctypes.c_int64),
)  # fmt: skip
_Buffers = _structure(
    "XLA_FFI_Args", struct_size=_size, extension_start=_pointer, size=ctypes.c_int64, types=_pointer,
    args=ctypes.POINTER(ctypes.POINTER(_Buffer)),
)  # fmt: skip
_CallFrame = _structure(
    "XLA_FFI_CallFrame", struct_size=_size, extension_start=ctypes.POINTER(_Extension), api=ctypes.POINTER(_Api),
    ctx=_pointer, stage=_int, args=_Buffers, rets=_Buffers,
)  # fmt: skip
_Entry = ctypes.CFUNCTYPE(_pointer, ctypes.POINTER(_CallFrame))
_LOCK = threading.RLock()
_AT_THE_END = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, b"the program is ending", INTERNAL_ERROR)
ctypes.pythonapi.Py_IncRef(ctypes.py_object(_AT_THE_END))  # in use as long as the process lives
_in_batch = threading.local()
_entries: dict[str, tuple[Hashable, object]] = {}
_num_inside = ctypes.c_int32(0)
"""Number of threads of XLA inside the gate."""
_is_closed = ctypes.c_int32(0)
"""Whether the gate is closed."""
SECONDS_TO_RETURN = 0.1
"""Time for daemon threads to return from native code to Python, where the end of the program is harmless."""


def installed_version() -> tuple[int, int] | None:
    """Return the version of the interface in the headers of the installed jaxlib; None if it has none."""
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    if not header.is_file():
        return None
    numbers = dict(re.findall(r"#define XLA_FFI_API_(MAJOR|MINOR) (\d+)", header.read_text(encoding="utf-8")))
    return int(numbers["MAJOR"]), int(numbers["MINOR"])


def refusal() -> str | None:
    """Return why functions cannot be registered with this jaxlib; None if they can.

    XLA keeps old minor versions working for a year, but no old major ones.
    """
    installed = installed_version()
    if installed is None or (installed[0] == VERSION[0] and installed >= VERSION):
        return None
    used = ".".join(map(str, VERSION))
    provided = ".".join(map(str, installed))
    return f"native loops use version {used} of XLA's foreign function interface, and this jaxlib {provided}"


def registered(description: str, key: Hashable, rank: int, make_handler: Callable[[], Handler]) -> str:
    """Return the name by which `call` reaches the handler for a key; make and register the handler if there is none.

    The rank is the number of axes of the first result, without the axes of batches.

    The same description gives the same name in every process, for XLA's compilation cache. If another key already has
    that description, such as a function that was defined again, the name differs. It begins with the first word of the
    description, because errors of JAX print it, as for `jax.export`.
    """
    name = f"a2tg_{description.split()[0]}_{hashlib.sha256(description.encode()).hexdigest()[:20]}"
    with _LOCK:
        while name in _entries and _entries[name][0] != key:
            name += "_"
        if name not in _entries:
            # Kept for the life of the process: XLA's programs hold its bare address.
            entry = _Entry(_entry(_batched(make_handler(), rank)))
            _entries[name] = key, entry
            jax.ffi.register_ffi_target(name, _capsule(_gated(entry)), platform="cpu")
    return name


def call(name: str, results: Sequence[tuple[tuple[int, ...], DTypeLike]], *inputs: Array) -> list[Array]:
    """Call a handler of `registered` inside a computation, given the shape and dtype of each result."""
    shapes = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in results]
    return list(jax.ffi.ffi_call(name, shapes, vmap_method="expand_dims")(*inputs))


def _batched(handler: Handler, rank: int) -> Handler:
    """Return a handler that also takes batches: arrays with a further leading axis for every `vmap`, of length 1 where
    all members share the array. The rank is the one given to `registered`."""

    def of_batch(arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
        sizes = results[0].shape[: results[0].ndim - rank]
        members = [
            ([_member(array, index) for array in arguments], [_member(array, index) for array in results])
            for index in np.ndindex(sizes)
        ]
        num = threads_of_handler()
        if len(members) < max(2, num):
            for member in members:
                handler(*member)
            return
        # One iterator for all threads: each one takes the next member when it is done with another.
        remaining = iter(members)

        def work(*_: int) -> None:
            _in_batch.is_member = True
            try:
                for member in remaining:
                    handler(*member)
            finally:
                _in_batch.is_member = False

        run_spans(work, even_spans(num, 1))

    return of_batch


def _member(array: np.ndarray, index: tuple[int, ...]) -> np.ndarray:
    """Return the array of a member of a batch, given its index along each axis of the batch."""
    places = (min(k, size - 1) for k, size in zip(index, array.shape, strict=False))
    # Without the ellipsis, a scalar would be copied.
    member: np.ndarray = array[(*places, ...)]
    return member


def threads_of_handler() -> int:
    """Return the number of threads that a handler may use; 1 in a batch whose members threads divide."""
    return 1 if getattr(_in_batch, "is_member", False) else threads.num_threads()


def _capsule(address: int | None, destructor: int | None = None) -> object:
    new_capsule = ctypes.pythonapi.PyCapsule_New
    new_capsule.restype = ctypes.py_object
    new_capsule.argtypes = (_pointer, ctypes.c_char_p, _pointer)
    return new_capsule(address, None, destructor)


GATE = """
define ptr @{name}(ptr %frame) {{
  ; Counted before the gate is looked at: the end closes it and then waits until no thread is inside, so misses none.
  atomicrmw add ptr inttoptr (i64 {num_inside} to ptr), i32 1 seq_cst
  %closed = load atomic i32, ptr inttoptr (i64 {is_closed} to ptr) seq_cst, align 4
  %is_open = icmp eq i32 %closed, 0
  br i1 %is_open, label %inside, label %outside
inside:
  %result = call ptr inttoptr (i64 {entry} to ptr)(ptr %frame)
  br label %leave
outside:
  ; frame->api->XLA_FFI_Error_Create(&_AT_THE_END)
  %api_place = getelementptr i8, ptr %frame, i64 {api}
  %api = load ptr, ptr %api_place
  %create_place = getelementptr i8, ptr %api, i64 {create_error}
  %create_error = load ptr, ptr %create_place
  %error = call ptr %create_error(ptr inttoptr (i64 {at_the_end} to ptr))
  br label %leave
leave:
  %returned = phi ptr [ %result, %inside ], [ %error, %outside ]
  atomicrmw sub ptr inttoptr (i64 {num_inside} to ptr), i32 1 seq_cst
  ret ptr %returned
}}
"""
"""A function like `entry`, frame → error, that makes an error if the gate is closed."""


def _gated(entry: Any) -> int:
    """Return the address of `GATE` around a function."""
    places = {"num_inside": _num_inside, "is_closed": _is_closed, "at_the_end": _AT_THE_END}
    name = llvm_code.unique("gate")
    code = GATE.format(
        name=name,
        entry=ctypes.cast(entry, _pointer).value,
        api=_CallFrame.api.offset,
        create_error=_Api.XLA_FFI_Error_Create.offset,
        **{field: ctypes.addressof(number) for field, number in places.items()},
    )
    return llvm_code.compile_text(code, [name])[name]


def _entry(handler: Handler) -> Callable[..., int | None]:
    """Return the function that XLA calls; it returns None on success, else the address of an error."""

    def enter(pointer: Any) -> int | None:
        frame = pointer.contents
        interrupts = list[int]()
        dropped_last: list[object] = []
        # No exception may pass through C: it would be lost, and the unfilled results would count as computed.
        try:
            with _interrupts_noted(interrupts):
                extension = frame.extension_start
                if extension and extension.contents.extension_base.type == METADATA_EXTENSION:
                    version = extension.contents.metadata.contents.api_version
                    version.major_version, version.minor_version = VERSION
                elif frame.stage == EXECUTE_STAGE:
                    handler(_arrays(frame.args), _arrays(frame.rets))
            if interrupts:
                dropped_last.append(_interrupt_once_dropped())
        except BaseException as error:
            if interrupts or isinstance(error, KeyboardInterrupt):
                dropped_last.append(_interrupt_once_dropped())
            what = "".join(traceback.format_exception_only(error))
            where = "".join(traceback.format_tb(error.__traceback__)[1:])
            message = f"{what}raised, most recent call last, at\n{where}".encode(errors="replace")
            error.with_traceback(None)  # A traceback would keep this function's variables alive.
            arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message, INTERNAL_ERROR)
            address: int = frame.api.contents.XLA_FFI_Error_Create(ctypes.byref(arguments))
            return address
        return None

    return enter


@contextlib.contextmanager
def _interrupts_noted(interrupts: list[int]) -> Iterator[None]:
    """Append Ctrl-C to a list instead of raising it, on the main thread, the only one that signals reach."""
    usual_handler = signal.getsignal(signal.SIGINT)
    if threading.get_ident() != threading.main_thread().ident or not callable(usual_handler):
        yield
        return
    signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual_handler)


def _interrupt_once_dropped() -> object:
    """Return an object that raises Ctrl-C in the main thread once it is deleted.

    If a variable of a function that XLA calls holds the last reference, that is after the function has returned.
    """
    interrupt = ctypes.cast(ctypes.pythonapi.PyErr_SetInterrupt, _pointer).value
    return _capsule(interrupt, interrupt)


def _arrays(buffers: Any) -> list[np.ndarray]:
    arrays = []
    for index in range(buffers.size):
        buffer = buffers.args[index].contents
        shape = tuple(buffer.dims[: buffer.rank])
        dtype = np.dtype(DTYPES[buffer.dtype])
        num_bytes = math.prod(shape) * dtype.itemsize
        # Buffers without numbers may have no address.
        memory = (ctypes.c_ubyte * num_bytes).from_address(buffer.data) if num_bytes else bytearray()
        arrays.append(np.frombuffer(memory, dtype).reshape(shape))
    return arrays


def even_spans(num: int, least_items: int) -> list[Span]:
    """Split 0..num into even spans, one per thread, of at least `least_items` each if there is more than one."""
    count = max(1, min(threads_of_handler(), num // max(1, least_items)))
    return list(itertools.pairwise(num * k // count for k in range(count + 1)))


def run_spans(work: Callable[[int, int, int], None], spans: Sequence[Span]) -> None:
    """Call work(first, last, index) for every span: the first one on this thread, the others on the pool's."""
    futures: list[concurrent.futures.Future[None]] = []
    try:
        for index, span in enumerate(spans[1:], start=1):
            futures.append(_pool(threads_of_handler()).submit(work, *span, index))
        work(*spans[0], 0)
    finally:
        # Also after an exception: nobody may write to XLA's buffers once they are given back.
        concurrent.futures.wait(futures)
    for future in futures:
        future.result()


@functools.cache
def _pool(size: int) -> concurrent.futures.ThreadPoolExecutor:
    return concurrent.futures.ThreadPoolExecutor(size, thread_name_prefix="a2tg")


if hasattr(os, "register_at_fork"):
    # The child has none of the parent's threads.
    os.register_at_fork(after_in_child=lambda: setattr(_num_inside, "value", 0))


@atexit.register
def _close() -> None:
    """Close the gate, and wait until no thread is inside and none waits for arrays."""
    if not _entries:
        return
    # Threads use the gate as long as the process lives, so its parts must outlive Python's shutdown.
    for part in (_num_inside, _is_closed, llvm_code.engine()):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(part))
    _is_closed.value = 1
    while _num_inside.value:
        time.sleep(1e-3)
    if threading.active_count() > 1:
        with contextlib.suppress(RuntimeError):  # No CPU among JAX's platforms.
            for array in jax.live_arrays("cpu"):
                with contextlib.suppress(RuntimeError):
                    array.block_until_ready()
        time.sleep(SECONDS_TO_RETURN)
