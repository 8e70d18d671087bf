"""Reader of pickled arrays that runs nothing that the file names.

A pickle is a program that calls the functions that it names. Here its opcodes are interpreted, and only those are
accepted that make numbers, text, bytes, tuples, lists, dicts, and NumPy's arrays of numbers or text. Not even `NAMES`
are imported: each stands for an operation of this module.
"""

from __future__ import annotations

import pickletools
import re
import warnings
from collections.abc import Callable
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
_EMPTY: dict[str, Callable[[], Any]] = {"EMPTY_LIST": list, "EMPTY_DICT": dict}
_COLLECTORS = {"MARK", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "APPEND", "APPENDS", "SETITEM", "SETITEMS"}
_CONSTRUCTORS = {"GLOBAL", "STACK_GLOBAL", "REDUCE", "BUILD"}


class _AllowedName(str):
    """Value of `NAMES`, distinguished from text in the file by its type."""


class _Unfinished:
    """Array, or type of arrays, whose state a later opcode of the file gives."""

    def __init__(self, kind: np.dtype | None = None) -> None:
        self.kind = kind


def load(path: Path) -> Any:
    """Return the content of a pickle of protocol 2 to 5; InputError if it is damaged or holds anything else."""
    try:
        with warnings.catch_warnings(action="ignore"):  # of odd text in damaged files
            return _interpreted(path.read_bytes())
    except (ValueError, TypeError, LookupError, OverflowError, MemoryError) as error:
        why = shorten(str(error), 120, placeholder=" ...")
        raise InputError(f"{path.name} is no whole pickle of plain arrays: {why}; nothing in it was run") from None


def _interpreted(content: bytes) -> Any:
    """Return the value that a pickle builds."""
    machine = _StackMachine()
    for opcode, argument, _ in pickletools.genops(content):
        machine.step(opcode.name, argument)
    (value,) = machine.stack
    return value


class _StackMachine:
    """State of a pickle's interpretation: the stack above the last mark, the stacks below each mark, and the memo."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.below_marks: list[list[Any]] = []
        self.memo: dict[int, Any] = {}

    def step(self, name: str, argument: Any) -> None:
        """Run one opcode; an InputError names one that is not accepted."""
        if name in _VALUES:
            self.stack.append(argument)
        elif name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name])
        elif name in _EMPTY:
            self.stack.append(_EMPTY[name]())
        elif name in _COLLECTORS:
            self._collect(name)
        elif name in ("BINPUT", "LONG_BINPUT", "MEMOIZE"):
            self.memo[len(self.memo) if argument is None else argument] = self.stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            self.stack.append(self.memo[argument])
        elif name in _CONSTRUCTORS:
            self._construct(name, argument)
        elif name not in ("PROTO", "FRAME", "STOP"):
            raise InputError(f"it has the step {name}")

    def _collect(self, name: str) -> None:
        """Run an opcode that puts items of the stack into a tuple, a list or a dict."""
        match name:
            case "MARK":
                self.below_marks.append(self.stack)
                self.stack = []
            case "TUPLE":
                items, self.stack = self.stack, self.below_marks.pop()
                self.stack.append(tuple(items))
            case "APPENDS" | "SETITEMS":
                items, self.stack = self.stack, self.below_marks.pop()
                _fill(self.stack[-1], items)
            case "APPEND" | "SETITEM":
                count = 1 if name == "APPEND" else 2
                self.stack, items = self.stack[:-count], self.stack[-count:]
                _fill(self.stack[-1], items)
            case _:  # TUPLE1, TUPLE2, TUPLE3
                count = int(name[-1])
                self.stack[-count:] = [tuple(self.stack[-count:])]

    def _construct(self, name: str, argument: Any) -> None:
        """Run an opcode that names a function, calls it, or gives its result a state."""
        match name:
            case "GLOBAL":
                self.stack.append(_allowed(argument))
            case "STACK_GLOBAL":
                self.stack[-2:] = [_allowed(" ".join(self.stack[-2:]))]
            case "REDUCE":
                self.stack[-2:] = [_result(*self.stack[-2:])]
            case "BUILD":
                unfinished, state = self.stack[-2:]
                finished = _finished(unfinished, state)
                self.stack[-2:] = [finished]
                self.memo = {key: finished if value is unfinished else value for key, value in self.memo.items()}


def _fill(container: Any, items: list[Any]) -> None:
    """Add items to a list, or keys and values in turn to a dict."""
    if isinstance(container, list):
        container.extend(items)
    elif isinstance(container, dict) and all(type(key) in (str, int, bytes) for key in items[::2]):
        container.update(zip(items[::2], items[1::2], strict=True))
    else:
        raise InputError("it fills what is no list, and no dict by text or numbers")


def _allowed(name: str) -> _AllowedName:
    """Return the operation that stands for a function; InputError if it is not one of `NAMES`."""
    if name not in NAMES:
        raise InputError(f"it names {name.replace(' ', '.')!r}")
    return _AllowedName(NAMES[name])


def _result(name: Any, arguments: Any) -> Any:
    """Return the result of an operation of `NAMES` with its arguments."""
    match name, arguments:
        case _AllowedName("empty"), (_AllowedName("array"), _, _):
            return _Unfinished()
        case _AllowedName("type"), (str(code), _, _):
            if not _TYPES.fullmatch(code):
                raise InputError(f"it has an array of type {code!r}")
            return _Unfinished(np.dtype(code))
        case _AllowedName("bytes"), ():
            return b""
        case _AllowedName("bytes"), (str(text), "latin1"):
            return text.encode("latin1")
        case _AllowedName("filled"), (raw, kind, shape, order):
            return _array(raw, kind, shape, order)
    raise InputError("it makes something that is not known")


def _finished(unfinished: Any, state: Any) -> Any:
    """Return the array or type of arrays that a state completes."""
    match unfinished, state:
        case _Unfinished(kind=None), (_, shape, kind, by_column, raw):
            return _array(raw, kind, shape, "F" if by_column else "C")
        case _Unfinished(kind=np.dtype() as kind), (_, "<" | ">" | "|" as order, None, None, None, *_):
            return kind.newbyteorder(order)
    raise InputError("it has an array of no plain kind")


def _array(raw: Any, kind: Any, shape: Any, order: Any) -> np.ndarray:
    """Return the array of a shape and type in these bytes; order: "C" or "F"."""
    if not isinstance(raw, bytes | bytearray) or not isinstance(kind, np.dtype):
        raise InputError("it has an array without bytes or type")
    array = np.ndarray(shape, kind, buffer=bytes(raw), order=order)
    if array.nbytes != len(raw):
        raise InputError(f"it has an array {shape} of {kind} in {len(raw)} bytes")
    return array.copy(order="K")
