"""Exceptions, as a tree, and the checks of arguments that all rooms share.

::

    SysidError                  anything this package raises on purpose
    ├── InputError (ValueError) the caller's mistake: what, where, what to do
    └── SolverError             a solver ended in a state that its caller cannot use

The command line turns an ``InputError`` into one line and exit status 2.

A check takes the argument's name, as messages call it, and its value; it gives the value as the plain type that was
asked for, or raises an ``InputError``.
"""

from __future__ import annotations

import importlib
import math
import operator
import unicodedata
from collections.abc import Sequence
from numbers import Real
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Marks that turn the direction of writing: by them a name may look like another one.
_TURNING = ("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")

MOST_LISTED = 8  # of many alike, that a message names

RandomSource: TypeAlias = "int | np.random.Generator | np.random.SeedSequence | None"  # NumPy loads it at first use


class SysidError(Exception):
    """Base of every error that this package raises on purpose."""


class InputError(SysidError, ValueError):
    """A mistake in what was given: data, a model, a file, an option."""


class SolverError(SysidError):
    """A numerical solver ended without a usable answer; the message has its status."""


class Stop(Exception):  # noqa: N818 - not an error
    """The callback asked to stop, or the time is over."""


def how_to_install(extra: str) -> str:
    """The command for an extra of the package, which works wherever it is installed."""
    return f"python -m pip install 'structural-sysid[{extra}]'"


def needed(package: str, extra: str, what: str) -> None:
    """Refuse `what` where a package of an extra is not installed, with the command for it."""
    try:
        importlib.import_module(package)
    except ImportError:
        raise InputError(f"{what} needs the package {package}: {how_to_install(extra)}") from None


def refuse(*mistakes: tuple[Any, str]) -> None:
    """Raise an `InputError` with the sentence of the first of ``(applies, sentence)`` that applies."""
    for applies, sentence in mistakes:
        if applies:
            raise InputError(sentence)


def shown(value: Any) -> str:
    """A value in a message, which stays one line."""
    words = " ".join(repr(value).split())
    return words if len(words) < 80 else f"{words[:77]}..."


def listed(words: Sequence[str], between: str = ", ") -> str:
    """Words in a message, and how many more there are beyond the first few."""
    more = len(words) - MOST_LISTED
    return between.join(words[:MOST_LISTED]) + f" and {more} more" * (more > 0)


def as_float(
    name: str, value: Any, wanted: str = "a finite number", *, above: float = -math.inf, at_least: float = -math.inf,
    below: float = math.inf, finite: bool = True,
) -> float:  # fmt: skip
    """One real number, no bool, within bounds; `wanted` says in the message what is."""
    plain = value.item() if type(value) is np.ndarray and value.ndim == 0 else value
    try:
        given = float(plain) if isinstance(plain, Real) and not isinstance(plain, bool) else math.nan
    except OverflowError:  # an int of more than 308 digits
        given = math.nan
    fits = above < given < below or (not finite and math.isinf(given))
    if not (fits and given >= at_least):
        raise InputError(f"{name} = {shown(value)}: {wanted} is needed")
    return given


def whole_number(name: str, value: Any, *, at_least: int, at_most: float = math.inf) -> int:
    """A whole number, no bool; a float such as 4.0 is one."""
    plain: Any = int(value) if isinstance(value, float) and value.is_integer() and abs(value) < 2**53 else value
    try:
        given = operator.index("" if isinstance(plain, bool) else plain)  # type: ignore[arg-type]
    except TypeError:
        raise InputError(f"{name} is {shown(value)}; give a whole number, {at_least} or above.") from None
    refuse(
        (given < at_least, f"{name} is {given}; give {at_least} or above."),
        (given > at_most, f"{name} is {shown(given)}; give {at_most:g} or below."),
    )
    return given


def text(name: str, value: Any) -> str:
    """A text that is not empty, and has no control characters."""
    refuse((not isinstance(value, str) or not value, f"{name} is {shown(value)}; give a text, such as 'top'"))
    return printable(name, value)


def printable(name: str, value: str) -> str:
    """A text without control characters, which may be empty: names and units stand in tables, pages and modules."""
    found = next((letter for letter in value if is_control(letter)), None)
    refuse((found is not None, f"{name} is {shown(value)}: it holds the control character {found!r}; leave it out"))
    return value


def is_control(letter: str) -> bool:
    """True where a letter ends a line, commands a terminal, or turns the direction of what follows."""
    return unicodedata.category(letter) in ("Cc", "Zl", "Zp") or unicodedata.bidirectional(letter) in _TURNING


def shown_plainly(text: str) -> str:
    """A text with its control characters, but for line feeds and tabs, written as Python writes them."""
    if text.isprintable():  # marks that turn the direction are not
        return text
    return "".join(
        letter.encode("unicode_escape").decode() if is_control(letter) and letter not in "\n\t" else letter
        for letter in text
    )


def flag(name: str, value: Any) -> bool:
    """True or False, NumPy's too."""
    refuse((not isinstance(value, bool | np.bool_), f"{name} is {shown(value)}; give True or False"))
    return bool(value)


def choice(name: str, value: Any, known: Sequence[str | None]) -> None:
    """Refuse what is none of the known words."""
    if not isinstance(value, str | None) or value not in known:
        raise InputError(f"{name} = {shown(value)} is unknown; give one of {', '.join(map(repr, known))}")


def instance(name: str, value: Any, kind: type) -> None:
    """Refuse what is no object of this class of the package."""
    refuse((not isinstance(value, kind), f"{name} is a {type(value).__name__}, not a sysid.{kind.__name__}"))


def function(name: str, value: Any) -> None:
    """Refuse what cannot be called; None passes."""
    if value is not None and not callable(value):
        raise InputError(f"{name} is {shown(value)}; give a function, or None")


def sequence(name: str, value: Any, wanted: str, length: int | None = None) -> tuple[Any, ...]:
    """The entries, so many or one and more, of a list, a tuple or anything else but a text that can be gone through."""
    try:
        entries = tuple(None if isinstance(value, str | bytes) else value)  # type: ignore[arg-type]
    except TypeError:
        raise InputError(f"{name} is {shown(value)}; give {wanted}") from None
    if len(entries) != length and (length or not entries):
        raise InputError(f"{name} has {len(entries)} entries; give {wanted}")
    return entries


def path_of(name: str, value: Any) -> Path:
    """A path of a file or a folder."""
    try:
        return Path(value)
    except TypeError:
        raise InputError(f"{name} is {shown(value)}; give a path") from None


def random_generator(rng: RandomSource) -> np.random.Generator:
    """The random source as a Generator: of an int of zero or above, a Generator, a SeedSequence or None."""
    try:
        return np.random.default_rng(rng)
    except (TypeError, ValueError):
        raise InputError(f"rng is {shown(rng)}; give an int of zero or above, a numpy Generator, or None.") from None


def numbers(name: str, value: ArrayLike, kind: type = float) -> NDArray[Any]:
    """A new array of numbers, float or complex, which may be NaN or infinite; texts and masked entries are none.

    It lies in memory row by row, however the given one lies, so that sums over it have the same bits as after storing.
    """
    words = {float: "real numbers", complex: "numbers"}[kind]
    if _is_masked(value):
        raise InputError(f"{name} has masked entries: drop those lines, or fill them with numbers (numpy.ma.filled)")
    try:
        given = np.array(value, order="C")
        code = given.dtype.kind
        if code == "O" and any(entry is None for entry in given.flat):  # which NumPy makes NaN
            code = "U"
        array: NDArray[Any] = given.astype(complex if code == "c" else kind, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # CasADi's symbols raise the last
        code = "U"
    if code not in "biufcO":  # the words for a record take longer than all else here: only where they are needed
        raise InputError(f"{name} is not an array of {words}: {shown(value)}")
    refuse((kind is float and code == "c", f"{name} is complex; real numbers are needed"))
    return array


def _is_masked(value: Any) -> bool:
    """True where an array, or one in lists of arrays, has masked entries."""
    if isinstance(value, list | tuple):
        return any(_is_masked(part) for part in value)
    return isinstance(value, np.ma.MaskedArray) and bool(np.ma.is_masked(value))


def finite_array(name: str, value: ArrayLike, kind: type = float) -> NDArray[Any]:
    """A new array of finite numbers, float or complex."""
    array = numbers(name, value, kind)
    bad = np.argwhere(~np.isfinite(array)).tolist()
    if bad:
        first = f", the first at index {tuple(bad[0])}" if array.ndim else ""
        raise InputError(f"{name} holds NaN or infinite entries ({len(bad)} of {array.size}{first})")
    return array


def check_frequencies(freq: ArrayLike, *, increasing: bool = True) -> NDArray[np.floating[Any]]:
    """Frequency lines in Hz as a finite, nonnegative (strictly increasing) one-dimensional array."""
    lines = np.atleast_1d(finite_array("freq", freq))
    if lines.ndim != 1 or lines.size == 0:
        raise InputError(f"freq has shape {lines.shape}; a list of lines in Hz is needed")
    if np.any((lines < 0) | (lines > 1e12)):
        raise InputError(f"freq holds a negative line, or one above 1e12 Hz: {lines.min():g} to {lines.max():g} Hz")
    if increasing and np.any(np.diff(lines) <= 0):
        at = int(np.argmax(np.diff(lines) <= 0))
        raise InputError(
            f"freq must rise strictly: line {at + 1} is {lines[at + 1]:g} Hz after {lines[at]:g} Hz; "
            "sort the lines and drop repeated ones"
        )
    return lines


def shaped_array(name: str, value: ArrayLike, *shape: int | str) -> NDArray[np.floating[Any]]:
    """`finite_array` of this shape; a word in the shape stands for any length, the same wherever it occurs."""
    array = finite_array(name, value)
    lengths: dict[int | str, int] = dict(zip(shape, array.shape, strict=False))
    lengths |= {length: length for length in shape if isinstance(length, int)}
    if array.shape != tuple(lengths.get(length) for length in shape):
        raise InputError(f"{name} has shape {array.shape}; it must be {shape}".replace("'", ""))
    return array


def symmetric_array(name: str, value: ArrayLike, size: int | str, tolerance: float) -> NDArray[np.floating[Any]]:
    """A symmetric array of this shape; refused where it is none."""
    array = shaped_array(name, value, size, size)
    scale = np.sqrt(np.abs(np.diag(array)))
    asymmetry = np.abs(array - array.T)
    if np.any(asymmetry > tolerance * np.outer(scale, scale) + 1e-12 * np.max(np.abs(array), initial=0.0)):
        i, j = np.unravel_index(int(np.argmax(asymmetry)), array.shape)
        raise InputError(
            f"{name} is not symmetric: [{i}, {j}] is {array[i, j]:.6g} and [{j}, {i}] is {array[j, i]:.6g}"
        )
    return (array + array.T) / 2


def check_positive_definite(name: str, matrix: NDArray[np.floating[Any]]) -> None:
    """Refuse a matrix that is not positive definite."""
    diagonal = np.diag(matrix)
    if np.any(diagonal <= 0):
        at = int(np.argmin(diagonal))
        raise InputError(f"{name} is not positive definite: diagonal entry {at} is {diagonal[at]:.6g}")
    lowest = lowest_eigenvalue(matrix)
    if lowest <= 10 * len(matrix) * np.finfo(float).eps:  # below that a factorisation finds only round-off
        raise InputError(f"{name} is not positive definite: its lowest eigenvalue is {lowest:.3g} of its diagonal")


def lowest_eigenvalue(matrix: NDArray[np.floating[Any]]) -> float:
    """Lowest eigenvalue with each row in units of its own diagonal, so that kg and kg m² can be judged together."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    scale[scale == 0] = scale.max()
    return float(np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0])
