"""BLAS and LAPACK of scipy by their addresses, to be called without the interpreter."""

from __future__ import annotations

import ctypes
from typing import Any

from scipy.linalg import cython_blas, cython_lapack


def address(name: str) -> int:
    """Where a routine lies, such as dgemm or dpotrf; all its arguments are pointers."""
    routines: dict[str, Any] = {**cython_blas.__pyx_capi__, **cython_lapack.__pyx_capi__}
    get_name = ctypes.pythonapi.PyCapsule_GetName
    get_name.restype, get_name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
    get_pointer.restype, get_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    found: int = get_pointer(routines[name], get_name(routines[name]))
    return found


def routine(name: str, n_arguments: int) -> ctypes._FuncPointer:
    """A routine as a ctypes function; ctypes releases the interpreter lock, scipy's wrappers do not."""
    return ctypes.CFUNCTYPE(None, *([ctypes.c_void_p] * n_arguments))(address(name))
