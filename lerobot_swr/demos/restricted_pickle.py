"""Reads pickled recordings without running anything that a pickle could ask for.

A pickle is a program. Here it can build nothing but plain containers, numbers, strings and numpy arrays,
under the names of numpy 1 and 2 alike. Even the arrays are built by this module from their recorded bytes, so
that numpy's own unpickling code never sees a hostile state.
"""

import io
import math
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np

_PLAIN_DTYPE = re.compile(r"[<>|=]?(?:b1|\?|[iuf][1248]|[US]\d{1,4})")


class UnsafePickleError(ValueError):
    """A pickle holds something other than numpy arrays and plain containers."""


def load_recording(path: Path) -> Any:
    """Read a pickle of dictionaries, lists, tuples, numbers, strings and numpy arrays.

    Args:
        path: The file.

    Raises:
        ValueError: Naming the file, if it is not a pickle, is damaged, or holds anything else.
    """
    try:
        loaded = _RecordingUnpickler(io.BytesIO(path.read_bytes())).load()
        return _with_arrays(loaded)
    except UnsafePickleError as error:
        raise UnsafePickleError(
            f"{path}: refused, it asks for {error}; recordings may hold "
            "numpy arrays and plain containers only"
        ) from error
    except OSError:
        raise
    except RecursionError as error:
        raise ValueError(f"{path}: not a readable recording (nested too deeply)") from error
    except Exception as error:  # a damaged or hostile pickle can fail in any way
        raise ValueError(f"{path}: not a readable recording ({type(error).__name__}: {error})") from error


class _RecordingUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        allowed = _ALLOWED.get((module.replace("numpy._core", "numpy.core"), name))
        if allowed is None:
            raise UnsafePickleError(f"{module}.{name}")
        return allowed

    def persistent_load(self, pid: Any) -> Any:
        raise UnsafePickleError(f"an external object ({pid!r})")


class _Dtype:
    """Stands for a pickled numpy dtype; accepts plain booleans, numbers and strings."""

    def __init__(self, spec: str, align: object = False, copy: object = True):
        if not isinstance(spec, str) or not _PLAIN_DTYPE.fullmatch(spec):
            raise UnsafePickleError(f"a numpy dtype {spec!r}")
        self.dtype = np.dtype(spec)

    def __setstate__(self, state: tuple) -> None:
        if state[1] == ">":
            self.dtype = self.dtype.newbyteorder(">")


class _NdarrayClass:
    """Stands for the class numpy.ndarray, which array pickles name."""


class _Array:
    """Stands for a pickled array until its bytes are known."""

    def __init__(self, array_class: object, shape: object, dtype: object):
        if array_class is not _NdarrayClass:
            raise UnsafePickleError("an array of another class than numpy.ndarray")
        self.array: np.ndarray | None = None

    def __setstate__(self, state: tuple) -> None:
        _version, shape, dtype, is_fortran, data = state
        self.array = _array_of_bytes(data, dtype, shape, "F" if is_fortran else "C")


def _array_of_bytes(data: Any, dtype: Any, shape: Any, order: str = "C") -> np.ndarray:
    if not isinstance(dtype, _Dtype):
        raise UnsafePickleError("an array without a plain dtype")
    if isinstance(data, str):  # protocols 0 to 2 of Python 2
        data = data.encode("latin1")
    if not isinstance(data, bytes | bytearray):
        raise UnsafePickleError("an array of Python objects")
    if not isinstance(shape, tuple) or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise ValueError(f"array shape {shape!r}")
    if math.prod(shape) * dtype.dtype.itemsize != len(data):
        raise ValueError(f"array of shape {shape} and dtype {dtype.dtype} with {len(data)} bytes")
    return np.frombuffer(data, dtype.dtype).reshape(shape, order="F" if order == "F" else "C")


def _array_from_buffer(data: Any, dtype: Any, shape: Any, order: str) -> np.ndarray:
    return _array_of_bytes(data, dtype, shape, order)


def _scalar(dtype: Any, data: Any) -> Any:
    return _array_of_bytes(data, dtype, ())[()]


def _latin1(text: str, encoding: str) -> bytes:
    """How protocols below 3 store bytes; no other codec, since some of them decompress."""
    if encoding != "latin1":
        raise UnsafePickleError(f"the codec {encoding!r}")
    return text.encode("latin1")


_ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy.core.multiarray", "_reconstruct"): _Array,
    ("numpy.core.multiarray", "scalar"): _scalar,
    ("numpy.core.numeric", "_frombuffer"): _array_from_buffer,
    ("numpy", "ndarray"): _NdarrayClass,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _latin1,
    ("collections", "OrderedDict"): dict,
}


def _with_arrays(value: Any) -> Any:
    """`value` with its stand-ins replaced by the arrays they stand for."""
    if isinstance(value, _Array):
        if value.array is None:
            raise ValueError("an array without data")
        return value.array
    if isinstance(value, dict):
        return {key: _with_arrays(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_with_arrays(item) for item in value)
    if value is None or isinstance(
        value, bool | int | float | str | bytes | bytearray | np.ndarray | np.generic
    ):
        return value
    raise UnsafePickleError(f"an object of type {type(value).__name__}")
