"""Functions of NumPy arrays that compiled programs call on a CPU, by a handler of XLA's FFI.

A program that calls Python by ``jax.pure_callback`` can wait for itself where JAX has few threads,
since the callback's arrays are copied by the same threads. Here the function reads and writes XLA's
own buffers, on the thread that XLA calls it on, and nothing waits.
"""

import ctypes
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.typing import DTypeLike

from mjx_reinforce.engine.cpu.handler import OFFSETS

#: (arguments [B, ...], results [B, ...] to be written): all arrays have one axis in front.
HostFunction = Callable[[Sequence[np.ndarray], Sequence[np.ndarray]], None]
_HANDLER = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
#: Bytes of XLA_FFI_Error_Create_Args, and XLA's number of an internal error.
_ERROR_BYTES = 28
_INTERNAL_ERROR = 13
_METADATA_EXTENSION = 1
#: Handlers that XLA knows, by their names; it calls them as long as the process lives.
_HANDLERS: dict[str, Any] = {}


class Spec(NamedTuple):
    """An array of one call: its shape without the axes in front, and its dtype."""

    shape: tuple[int, ...]
    dtype: DTypeLike


class HostCall:
    """A host function as an operation of traced programs.

    Under ``jax.vmap``, also nested, the function is called once with all rows.
    """

    def __init__(
        self, key: str, function: HostFunction, arguments: Sequence[Spec], results: Sequence[Spec]
    ):
        """Tells XLA of the function.

        Args:
          key: a hash of all that the function depends on; the name of the operation has it.
          function: writes the results; it may not call JAX.
          arguments: of each argument.
          results: of each result.
        """
        self.key = key
        self._function = function
        self._arguments = [*map(_normal, arguments)]
        self._results = [*map(_normal, results)]
        self._target = f"mjx_reinforce_host_{key}"
        if self._target not in _HANDLERS:
            jax.devices()  # a handler refused before XLA has started would keep it from starting
            _HANDLERS[self._target] = _HANDLER(self._handle)
            address = ctypes.cast(_HANDLERS[self._target], ctypes.c_void_p)
            jax.ffi.register_ffi_target(self._target, jax.ffi.pycapsule(address), platform="cpu")

    def __call__(self, *arguments: jax.Array) -> Sequence[jax.Array]:
        """Calls the function, while a program is traced or at once."""
        results = [jax.ShapeDtypeStruct(spec.shape, spec.dtype) for spec in self._results]
        if jax.default_backend() == "cpu":
            call = jax.ffi.ffi_call(self._target, results, vmap_method="broadcast_all")
            return call(*arguments)
        # From a GPU's program the arrays go to the CPU and back.
        return jax.pure_callback(self._call_back, results, *arguments, vmap_method="broadcast_all")

    def _call_back(self, *arguments: jax.Array) -> list[np.ndarray]:
        """Computes the results of arrays that a GPU's program sent."""
        inputs = [np.asarray(argument) for argument in arguments]
        num_axes = inputs[0].ndim - len(self._arguments[0].shape)
        batch = inputs[0].shape[:num_axes]
        outputs = [np.empty((*batch, *spec.shape), spec.dtype) for spec in self._results]
        self._compute(inputs, outputs)
        return outputs

    def _compute(self, inputs: list[np.ndarray], outputs: list[np.ndarray]) -> None:
        """Calls the function with one axis in front of all arrays, however many there are."""
        self._function(_one_axis(inputs, self._arguments), _one_axis(outputs, self._results))

    def _handle(self, frame: int) -> int | None:
        """Serves XLA, which registers the handler or executes it; returns its error, or None."""
        extension = _pointer(frame + OFFSETS["XLA_FFI_CallFrame.extension_start"])
        if extension:
            kind = extension + OFFSETS["XLA_FFI_Metadata_Extension.extension_base.type"]
            if ctypes.c_int32.from_address(kind).value == _METADATA_EXTENSION:
                _tell_version(frame, extension)
                return None
        # A Python error cannot cross XLA's frames: it becomes an error of XLA's.
        try:
            inputs = _arrays(frame, "args", self._arguments)
            self._compute(inputs, _arrays(frame, "rets", self._results))
        except BaseException as error:  # whatever it is, it must not unwind into XLA
            return _error(frame, f"{type(error).__name__}: {error}")
        return None


def _normal(spec: Spec) -> Spec:
    return Spec(tuple(spec.shape), np.dtype(spec.dtype))


def _one_axis(arrays: list[np.ndarray], specs: Sequence[Spec]) -> list[np.ndarray]:
    """Returns views [B, ...] of arrays with any number of axes in front."""
    rows = []
    for array, spec in zip(arrays, specs, strict=True):
        front = array.shape[: array.ndim - len(spec.shape)]
        rows.append(array.reshape(math.prod(front), *spec.shape))
    return rows


def _pointer(address: int) -> int:
    """Returns the pointer at an address; 0 if it is null."""
    return ctypes.c_void_p.from_address(address).value or 0


def _arrays(frame: int, kind: str, specs: Sequence[Spec]) -> list[np.ndarray]:
    """Returns XLA's buffers of a call as arrays, without a copy.

    Args:
      frame: the address of XLA's XLA_FFI_CallFrame.
      kind: "args" or "rets".
      specs: of each buffer.
    """
    buffers = _pointer(frame + OFFSETS[f"XLA_FFI_CallFrame.{kind}.{kind}"])
    arrays = []
    for number, spec in enumerate(specs):
        buffer = _pointer(buffers + number * ctypes.sizeof(ctypes.c_void_p))
        rank = ctypes.c_int64.from_address(buffer + OFFSETS["XLA_FFI_Buffer.rank"]).value
        dims = _pointer(buffer + OFFSETS["XLA_FFI_Buffer.dims"])
        # Of a scalar the pointer to the dimensions may be null.
        shape = ()
        if rank:
            shape = tuple((ctypes.c_int64 * rank).from_address(dims))
        num_bytes = math.prod(shape) * np.dtype(spec.dtype).itemsize
        if not num_bytes:
            arrays.append(np.empty(shape, spec.dtype))
            continue
        data = _pointer(buffer + OFFSETS["XLA_FFI_Buffer.data"])
        memory: Any = (ctypes.c_char * num_bytes).from_address(data)
        arrays.append(np.frombuffer(memory, spec.dtype).reshape(shape))
    return arrays


def _tell_version(frame: int, extension: int) -> None:
    """Says: major version 0, and the minor version that XLA speaks; they only add to each other."""
    metadata = _pointer(extension + OFFSETS["XLA_FFI_Metadata_Extension.metadata"])
    api = _pointer(frame + OFFSETS["XLA_FFI_CallFrame.api"])
    minor = ctypes.c_int32.from_address(api + OFFSETS["XLA_FFI_Api.api_version.minor_version"])
    for field, number in (
        ("api_version.major_version", 0),
        ("api_version.minor_version", minor.value),
        ("traits", 0),
    ):
        address = metadata + OFFSETS[f"XLA_FFI_Metadata.{field}"]
        ctypes.c_int32.from_address(address).value = number


def _error(frame: int, text: str) -> int:
    """Returns XLA's error with a text."""
    api = _pointer(frame + OFFSETS["XLA_FFI_CallFrame.api"])
    create = _HANDLER(_pointer(api + OFFSETS["XLA_FFI_Api.XLA_FFI_Error_Create"]))
    message = ctypes.create_string_buffer(text.encode())
    fields = (_ERROR_BYTES, 0, ctypes.addressof(message), _INTERNAL_ERROR)
    arguments = (ctypes.c_int64 * len(fields))(*fields)
    return create(ctypes.addressof(arguments))
