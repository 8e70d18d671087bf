"""Reader of pickled arrays that runs nothing that the file names.

A pickle is a program that calls the functions that it names. Here its opcodes are interpreted, and only those are
accepted that make numbers, text, bytes, tuples, lists, dicts, and NumPy's arrays of numbers or text. Not even `NAMES`
are imported: each stands for an operation of this module.
"""

from __future__ import annotations

import pickletools
import re
import warnings
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np

from larp_model.errors import InputError

_CORES = ("numpy.core", "numpy._core")
# Functions that a file may name, with the name of the operation here.
NAMES = {
    "numpy ndarray": "array",
    "numpy dtype": "type",
    "_codecs encode": "bytes",
    "__builtin__ bytes": "bytes",
    **{f"{core}.multiarray _reconstruct": "empty" for core in _CORES},
    **{f"{core}.numeric _frombuffer": "filled" for core in _CORES},
}
_TYPES = re.compile(r"b1|[iu][1248]|f[248]|[SU][1-9]\d{0,5}")
_VALUES = {
    *("BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT"),
    *("BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"),
    *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}


class _Name(str):
    """Value of `NAMES`, distinguished from text in the file by its type."""


class _Unfinished:
    """Array, or type of arrays, whose state a later opcode of the file gives."""

    def __init__(self, kind: np.dtype | None = None) -> None:
        self.kind = kind


def load(path: Path) -> Any:
    """Return the content of a pickle of protocol 2 to 5; InputError if it is damaged or holds anything else."""
    try:
        with warnings.catch_warnings(action="ignore"):  # of odd text in damaged files
            return _followed(path.read_bytes())
    except (ValueError, TypeError, LookupError, OverflowError, MemoryError) as error:
        why = shorten(str(error), 120, placeholder=" ...")
        raise InputError(f"{path.name} is no whole pickle of plain arrays: {why}; nothing in it was run") from None


def _followed(content: bytes) -> Any:
    stack: list[Any] = []
    before: list[list[Any]] = []  # what was on the stack at each mark
    memo: dict[int, Any] = {}
    given: Any
    for step, given, _ in pickletools.genops(content):
        top: list[Any] = []
        if step.name in ("TUPLE", "APPENDS", "SETITEMS"):
            top, stack = stack, before.pop()
        match step.name:
            case name if name in _VALUES:
                stack.append(given)
            case name if name in _CONSTANTS:
                stack.append(_CONSTANTS[name])
            case "EMPTY_LIST" | "EMPTY_DICT" as name:
                stack.append([] if name == "EMPTY_LIST" else {})
            case "MARK":
                before.append(stack)
                stack = []
            case "TUPLE":
                stack.append(tuple(top))
            case "TUPLE1" | "TUPLE2" | "TUPLE3" as name:
                count = int(name[-1])
                stack[-count:] = [tuple(stack[-count:])]
            case "APPEND" | "SETITEM" as name:
                count = 1 if name == "APPEND" else 2
                stack, top = stack[:-count], stack[-count:]
                _fill(stack[-1], top)
            case "APPENDS" | "SETITEMS":
                _fill(stack[-1], top)
            case "BINPUT" | "LONG_BINPUT" | "MEMOIZE":
                memo[len(memo) if given is None else given] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[given])
            case "GLOBAL":
                stack.append(_named(given))
            case "STACK_GLOBAL":
                stack[-2:] = [_named(" ".join(stack[-2:]))]
            case "REDUCE":
                stack[-2:] = [_made(*stack[-2:])]
            case "BUILD":
                unfinished, state = stack[-2:]
                stack[-2:] = [_finished(unfinished, state)]
                memo = {key: stack[-1] if held is unfinished else held for key, held in memo.items()}
            case name if name not in ("PROTO", "FRAME", "STOP"):
                raise InputError(f"it has the step {name}")
    (found,) = stack
    return found


def _fill(held: Any, items: list[Any]) -> None:
    if isinstance(held, list):
        held.extend(items)
    elif isinstance(held, dict) and all(type(key) in (str, int, bytes) for key in items[::2]):
        held.update(zip(items[::2], items[1::2], strict=True))
    else:
        raise InputError("it fills what is no list, and no dict by text or numbers")


def _named(name: str) -> _Name:
    if name not in NAMES:
        raise InputError(f"it names {name.replace(' ', '.')!r}")
    return _Name(NAMES[name])


def _made(name: Any, arguments: Any) -> Any:
    match name, arguments:
        case _Name("empty"), (_Name("array"), _, _):
            return _Unfinished()
        case _Name("type"), (str(code), _, _):
            if not _TYPES.fullmatch(code):
                raise InputError(f"it has an array of type {code!r}")
            return _Unfinished(np.dtype(code))
        case _Name("bytes"), ():
            return b""
        case _Name("bytes"), (str(text), "latin1"):
            return text.encode("latin1")
        case _Name("filled"), (raw, kind, shape, order):
            return _array(raw, kind, shape, order)
    raise InputError("it makes something that is not known")


def _finished(unfinished: Any, state: Any) -> Any:
    match unfinished, state:
        case _Unfinished(kind=None), (_, shape, kind, by_column, raw):
            return _array(raw, kind, shape, "F" if by_column else "C")
        case _Unfinished(kind=np.dtype() as kind), (_, "<" | ">" | "|" as order, None, None, None, *_):
            return kind.newbyteorder(order)
    raise InputError("it has an array of no plain kind")


def _array(raw: Any, kind: Any, shape: Any, order: Any) -> np.ndarray:
    if not isinstance(raw, bytes | bytearray) or not isinstance(kind, np.dtype):
        raise InputError("it has an array without bytes or type")
    array = np.ndarray(shape, kind, buffer=bytes(raw), order=order)
    if array.nbytes != len(raw):
        raise InputError(f"it has an array {shape} of {kind} in {len(raw)} bytes")
    return array.copy(order="K")
