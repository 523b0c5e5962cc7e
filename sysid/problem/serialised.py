"""CasADi's text of functions of our own: it alone tells some of what they are. It is written here, and never read."""

from __future__ import annotations

import struct
from itertools import pairwise

import casadi as ca

_NUMBER, _COUNT = "<cd", "<cq"  # a letter for the type, and eight bytes


def same_text(one: ca.Function, other: ca.Function) -> bool:
    """True where two functions are the same, node by node and option by option."""
    return bool(one.serialize() == other.serialize())


def is_compiled(function: ca.Function) -> bool:
    """True where a function, or one that it calls, is to be compiled (CasADi's option jit)."""
    try:
        return b"FunctionInternal::jitb\1" in _described(function)
    except (RuntimeError, NotImplementedError):  # it calls a Python callback, which has no text
        return False


def interpolant_data(function: ca.Function) -> tuple[list[list[float]], list[float]]:
    """Points of the grid along each axis of an interpolant, and the values there; empty where they are its inputs."""
    text = _described(function)
    grid, ends = _vector(text, b"Interpolant::grid", _NUMBER), _vector(text, b"Interpolant::offset", _COUNT)
    values = _vector(text, b"Interpolant::values", _NUMBER)
    return [grid[int(a) : int(b)] for a, b in pairwise(ends)], values


def interpolant_options(function: ca.Function) -> bytes:
    """All that an interpolant keeps beside the values of its inputs and what CasADi has derived of it."""
    text = _described(function)
    return text[text.index(b"Interpolant::ndim") :].partition(b"BSplineInterpolant::")[0]


def _described(function: ca.Function) -> bytes:
    """The text with the names of its fields; a byte is two letters from "a" on, its lower half first."""
    text = function.serialize({"debug": True}).encode()
    halves = bytes(letter - ord("a") for letter in text)
    return bytes(low | high << 4 for low, high in zip(halves[::2], halves[1::2], strict=True))


def _vector(text: bytes, name: bytes, form: str) -> list[float]:
    """A vector of numbers behind its name: "V", their count, and each with its type."""
    at = text.index(name) + len(name) + 1
    count = struct.unpack_from(_COUNT, text, at)[1]
    first, size = at + struct.calcsize(_COUNT), struct.calcsize(form)
    return [struct.unpack_from(form, text, first + i * size)[1] for i in range(count)]
