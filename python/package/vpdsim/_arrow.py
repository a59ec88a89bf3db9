"""The columns of a run for programs of Arrow, by its C data interface (the PyCapsule protocol), without a copy.

Invariant: what an exported structure points to lives until its release is called.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

NULLABLE = 2


class Schema(ctypes.Structure):
    """struct ArrowSchema"""


class Array(ctypes.Structure):
    """struct ArrowArray"""


class Stream(ctypes.Structure):
    """struct ArrowArrayStream"""


Release = {kind: ctypes.CFUNCTYPE(None, ctypes.POINTER(kind)) for kind in (Schema, Array, Stream)}
GetSchema = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(Stream), ctypes.POINTER(Schema))
GetNext = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(Stream), ctypes.POINTER(Array))
GetLastError = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(Stream))

Schema._fields_ = [
    ("format", ctypes.c_char_p),
    ("name", ctypes.c_char_p),
    ("metadata", ctypes.c_char_p),
    ("flags", ctypes.c_int64),
    ("n_children", ctypes.c_int64),
    ("children", ctypes.POINTER(ctypes.POINTER(Schema))),
    ("dictionary", ctypes.POINTER(Schema)),
    ("release", Release[Schema]),
    ("private_data", ctypes.c_void_p),
]
Array._fields_ = [
    ("length", ctypes.c_int64),
    ("null_count", ctypes.c_int64),
    ("offset", ctypes.c_int64),
    ("n_buffers", ctypes.c_int64),
    ("n_children", ctypes.c_int64),
    ("buffers", ctypes.POINTER(ctypes.c_void_p)),
    ("children", ctypes.POINTER(ctypes.POINTER(Array))),
    ("dictionary", ctypes.POINTER(Array)),
    ("release", Release[Array]),
    ("private_data", ctypes.c_void_p),
]
Stream._fields_ = [
    ("get_schema", GetSchema),
    ("get_next", GetNext),
    ("get_last_error", GetLastError),
    ("release", Release[Stream]),
    ("private_data", ctypes.c_void_p),
]

# What is kept for each exported structure, by its number, which stands in its private data.
kept: dict[int, Any] = {}
numbers = itertools.count(1)


def keep(structure: Any, *owned: Any) -> Any:
    number = next(numbers)
    structure.private_data = number
    structure.release = releases[type(structure)]
    kept[number] = (structure, owned)
    return structure


def released(pointer: Any) -> None:
    """Releases a structure, and those below it that nobody has taken."""
    structure = pointer.contents
    for at in range(getattr(structure, "n_children", 0)):
        child = structure.children[at]
        if child.contents.release:
            child.contents.release(child)
    number = structure.private_data
    structure.release = type(structure.release)()
    kept.pop(number, None)


releases = {kind: Release[kind](released) for kind in Release}


def schema(name: str, form: str, children: list[Any]) -> Any:
    pointers = (ctypes.POINTER(Schema) * len(children))(*(ctypes.pointer(child) for child in children))
    made = Schema(format=form.encode(), name=name.encode(), flags=0 if form == "+s" else NULLABLE,
                  n_children=len(children), children=pointers)
    return keep(made, children, pointers)


def array(length: int, buffers: list[NDArray[Any] | None], children: list[Any], nulls: int = 0) -> Any:
    addresses = [None if buffer is None else buffer.ctypes.data for buffer in buffers]
    places = (ctypes.c_void_p * len(buffers))(*addresses)
    pointers = (ctypes.POINTER(Array) * len(children))(*(ctypes.pointer(child) for child in children))
    made = Array(length=length, null_count=nulls, n_buffers=len(buffers), buffers=places,
                 n_children=len(children), children=pointers)
    return keep(made, buffers, places, children, pointers)


def column_schema(name: str, values: NDArray[Any]) -> Any:
    if values.dtype.kind == "U":
        return schema(name, "u", [])
    form = {"f": "g", "u": "L"}[values.dtype.kind]
    if values.ndim == 1:
        return schema(name, form, [])
    width = int(np.prod(values.shape[1:]))
    return schema(name, f"+w:{width}", [schema("item", form, [])])


def numbers_array(values: NDArray[Any]) -> Any:
    """A number that is NaN is one that a sample does not have: null."""
    missing = np.isnan(values) if values.dtype.kind == "f" else np.zeros(0, bool)
    nulls = int(missing.sum())
    valid = np.packbits(~missing, bitorder="little") if nulls else None
    return array(len(values), [valid, values], [], nulls)


def column_array(values: NDArray[Any]) -> Any:
    values = np.ascontiguousarray(values)
    if values.dtype.kind == "U":
        words = [word.encode() for word in values.tolist()]
        ends = np.cumsum([0] + [len(word) for word in words], dtype=np.int32)
        data = np.frombuffer(b"".join(words) or b"\0", dtype=np.uint8)
        return array(len(words), [None, ends, data], [])
    if values.ndim == 1:
        return numbers_array(values)
    return array(len(values), [None], [numbers_array(values.reshape(-1))])


def guarded(call: Any) -> Any:
    """No exception may leave a function that C calls; these have none to tell but memory."""

    def guard(*arguments: Any) -> int:
        try:
            call(*arguments)
        except BaseException:
            return 12
        return 0

    return guard


def moved(made: Any, to: Any) -> None:
    """Gives a structure to its receiver, as the interface says: the bytes, once."""
    ctypes.memmove(to, ctypes.byref(made), ctypes.sizeof(made))


def stream(columns: Mapping[str, NDArray[Any]]) -> object:
    """A capsule with the columns as a stream of one batch."""
    columns = dict(columns)
    left = [columns]

    def get_schema(_: Any, to: Any) -> None:
        moved(schema("", "+s", [column_schema(name, values) for name, values in columns.items()]), to)

    def get_next(_: Any, to: Any) -> None:
        if not left:
            ctypes.memset(to, 0, ctypes.sizeof(Array))
            return
        batch = left.pop()
        length = len(batch["time_s"])
        moved(array(length, [None], [column_array(values) for values in batch.values()]), to)

    made = Stream(get_schema=GetSchema(guarded(get_schema)), get_next=GetNext(guarded(get_next)),
                  get_last_error=GetLastError(lambda _: None))
    return capsule(keep(made, columns))


NAME = b"arrow_array_stream"
Destructor = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
new_capsule = ctypes.pythonapi.PyCapsule_New
new_capsule.restype = ctypes.py_object
new_capsule.argtypes = [ctypes.c_void_p, ctypes.c_char_p, Destructor]
pointer_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi))
# A capsule that nobody took releases its stream; one that was taken has none left.
places: dict[int, Any] = {}


def forget(address: int) -> None:
    at = pointer_of(address, NAME)
    made = places.pop(at, None)
    if made is not None and made.release:
        made.release(ctypes.pointer(made))


destroy = Destructor(forget)


def capsule(made: Any) -> object:
    at = ctypes.addressof(made)
    places[at] = made
    return new_capsule(at, NAME, destroy)
