"""Operations by which the expressions of a problem stand in a file, and CasADi's own text of functions of our own.

A file can ask for these alone. Files name them in words; CasADi's numbers for them change from one version to the next.
CasADi's text alone tells some of what functions are; it is written here, and never read from a file.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np

from sysid.errors import InputError

_NUMBER, _COUNT = "<cd", "<cq"  # a letter for the type, and eight bytes


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


@dataclass(frozen=True)
class FileLimits:
    """The most that a file can ask for: many times what a problem of some hundred degrees of freedom takes."""

    operations: int = 3_000_000
    axes: int = 10  # of the grid of an interpolant
    entries: int = 10_000_000  # of one matrix, zeros too: 80 MB
    stored: int = 30_000_000  # nonzeros of all patterns of matrices together
    work: int = 3_000_000_000  # multiplications in one evaluation: some seconds
    memory: int = 50_000_000  # numbers that one evaluation keeps at a time: 400 MB


LIMITS = FileLimits()

# Each entry by itself, with the names of CasADi's constants.
UNARY = (
    "neg", "exp", "log", "sqrt", "sq", "twice", "sin", "cos", "tan", "asin", "acos", "atan", "floor", "ceil", "not",
    "fabs", "sign", "erf", "inv", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erfinv", "log1p", "expm1",
)  # fmt: skip
BINARY = (
    "add", "sub", "mul", "div", "pow", "constpow", "lt", "le", "eq", "ne", "and", "or", "fmod", "remainder", "copysign",
    "if_else_zero", "fmin", "fmax", "atan2", "hypot",
)  # fmt: skip
# Linear solvers that come with CasADi and load no further library.
SOLVERS = ("qr", "ldl", "lapackqr", "lapacklu", "csparse", "csparsecholesky", "lsqr", "tridiag", "mumps")
INTERPOLANTS = {"linear": "LinearInterpolant", "bspline": "BSplineInterpolant"}  # CasADi's classes of them

ENTRYWISE = dict.fromkeys(UNARY, 1) | dict.fromkeys(BINARY, 2)  # number of arguments
JOINING = ("vertcat", "horzcat", "diagcat")
RESHAPING: dict[str, Callable[..., ca.MX]] = {
    "reshape": ca.reshape, "project": ca.project, "sparsity_cast": ca.sparsity_cast,
}  # fmt: skip


def split_matrix(name: str, x: ca.MX, *offsets: int) -> list[ca.MX]:
    """Pieces of a matrix between offsets of its rows, its columns, or both (in turn: of rows, of columns)."""
    # The function of CasADi's, and of each of its lists of offsets where it ends.
    split, ends = {
        "vertsplit": (ca.vertsplit, x.shape[:1]), "horzsplit": (ca.horzsplit, x.shape[1:]),
        "diagsplit": (ca.diagsplit, x.shape),
    }[name]  # fmt: skip
    lists = [list(offsets[i :: len(ends)]) for i in range(len(ends))]
    for rising, end in zip(lists, ends, strict=True):
        if len(rising) < 2 or rising[0] != 0 or rising[-1] != end or any(b < a for a, b in pairwise(rising)):
            raise ValueError("offsets do not rise from the first row or column to the last")
    return list(split(x, *lists))


# Numbers of arguments and of parameters, None for any, and what makes a matrix, or several, of both.
MATRICES: dict[str, tuple[int | None, int | None, Callable[..., ca.MX | list[ca.MX]]]] = {
    "transpose": (1, 0, lambda x: x.T),
    "mtimes": (3, 0, lambda z, x, y: ca.mac(x, y, z)),  # z + x y
    "dot": (2, 0, ca.dot),
    "bilin": (3, 0, ca.bilin),
    "rank1": (4, 0, ca.rank1),
    "kron": (2, 0, ca.kron),
    "norm1": (1, 0, ca.norm_1),
    "norm2": (1, 0, ca.norm_2),
    "normf": (1, 0, ca.norm_fro),
    "norminf": (1, 0, ca.norm_inf),
    "determinant": (1, 0, ca.det),
    "mmin": (1, 0, ca.mmin),
    "mmax": (1, 0, ca.mmax),
    "logsumexp": (1, 0, ca.logsumexp),
    "find": (1, 0, ca.find),
    "low": (2, 0, ca.low),
    **{name: (None, 0, getattr(ca, name)) for name in JOINING},
    **{name: (1, None, partial(split_matrix, name)) for name in ("vertsplit", "horzsplit", "diagsplit")},
    "horzrepmat": (1, 1, lambda x, count: ca.repmat(x, 1, count)),
    "horzrepsum": (1, 1, lambda x, count: ca.repsum(x, 1, count)),
}
WITHOUT_PARAMETERS = frozenset({*ENTRYWISE, *(name for name, (_, count, _) in MATRICES.items() if count == 0)})
NAMES = (
    *ENTRYWISE, *MATRICES, *RESHAPING, "const", "getnonzeros", "setnonzeros", "addnonzeros", "einstein", "solve",
    "call",
)  # fmt: skip


def casadi_number(name: str) -> int:
    """CasADi's number of an operation, in the version at hand."""
    return int(getattr(ca, f"OP_{name.upper()}"))


def casadi_name(number: int) -> str:
    """The name of an operation by CasADi's number."""
    names = (name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == number)
    return next(names, f"operation {number}").removeprefix("OP_").lower()


def has_library(kind: str, name: str) -> bool:
    """True where a solver or an interpolant comes with CasADi: its library stands in CasADi's own folder."""
    return any(Path(ca.__file__).parent.glob(f"libcasadi_{kind}_{name}.*"))


def get_nonzeros(x: ca.MX, pattern: ca.Sparsity, places: Sequence[int]) -> ca.MX:
    """Nonzeros of x as those of another pattern; place -1 gives zero."""
    _check_places(places, x.nnz())
    if len(places) != pattern.nnz():
        raise ValueError(f"{len(places)} places for {pattern.nnz()} entries")
    return x.nzref(pattern, list(places))


def set_nonzeros(y: ca.MX, x: ca.MX, places: Sequence[int], *, add: bool) -> ca.MX:
    """Give y with the nonzeros of x in, or added to, those of its own at some places; place -1 is left out."""
    _check_places(places, y.nnz())
    if len(places) != x.nnz():
        raise ValueError(f"{len(places)} places for {x.nnz()} entries")
    result = ca.MX(y)
    if not add:
        used = [i for i, place in enumerate(places) if place >= 0]
        result.nz[[places[i] for i in used]] = x.nz[used]
        return result
    # A place that occurs several times is added to in turn, as CasADi does it.
    left = [i for i, place in enumerate(places) if place >= 0]
    while left:
        taken: dict[int, int] = {}
        for i in left:
            taken.setdefault(places[i], i)
        at, of = list(taken), list(taken.values())
        result.nz[at] = result.nz[at] + x.nz[of]
        chosen = set(of)
        left = [i for i in left if i not in chosen]
    return result


def _check_places(places: Sequence[int], count: int) -> None:
    if len(places) and not (min(places) >= -1 and max(places) < count):
        raise ValueError(f"a place is not among {count} entries")


def einstein(c: ca.MX, a: ca.MX, b: ca.MX, tensors: Sequence[Sequence[int]]) -> ca.MX:
    """Einstein sum c + a b over indices; `tensors`: dimensions of a, b, c, then the indices of a, b, c.

    CasADi checks neither, and reads beyond the arrays where they are wrong.
    """
    dimensions, indices = tensors[:3], tensors[3:]
    found: dict[int, int] = {}
    for value, sizes, names in zip((a, b, c), dimensions, indices, strict=True):
        if len(sizes) != len(names) or len(set(names)) != len(names) or min([*sizes, 1]) < 1:
            raise ValueError("dimensions and indices do not agree")
        if not value.is_dense() or value.numel() != int(np.prod(sizes, dtype=float)):
            raise ValueError("a tensor has another size than its dimensions")
        for size, index in zip(sizes, names, strict=True):
            if index >= 0 or found.setdefault(index, size) != size:
                raise ValueError("an index has two sizes")
    if any(index not in {*indices[0], *indices[1]} for index in indices[2]):
        raise ValueError("an index of the sum is in neither factor")
    return ca.einstein(a, b, c, *map(list, dimensions), *map(list, indices))


def linear_solve(solver: str, b: ca.MX, a: ca.MX, *, transposed: bool) -> ca.MX:
    """Give a⁻¹ b, or aᵀ⁻¹ b, by a linear solver of `SOLVERS`, "" the substitution where a is triangular."""
    if a.size1() != a.size2() or a.size1() != b.size1():
        raise ValueError("a system of equations is not square")
    if not solver:
        if transposed or not (a.sparsity().is_triu() or a.sparsity().is_tril()):
            raise ValueError("a matrix is not triangular")
        return ca.solve(a, b)
    check_library("linsol", solver, SOLVERS)
    return ca.Linsol(LINEAR, solver, a.sparsity()).solve(a, b, transposed)


LINEAR = "tmp_solve"  # as ca.solve calls its solvers


def check_library(kind: str, name: str, allowed: Sequence[str]) -> None:
    """Refuse a solver or an interpolant that is not allowed, or that this CasADi does not have."""
    if name not in allowed:
        raise ValueError(f"{name!r} is none of {', '.join(allowed)}")
    if not has_library(kind, name):
        raise InputError(f"they need CasADi's {name}, which this installation of CasADi does not have")
