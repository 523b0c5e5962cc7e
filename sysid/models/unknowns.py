"""The unknowns of an identification problem: named, shaped, bounded, scaled."""

from __future__ import annotations

import operator
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, finite_array, flag, numbers, printable, refuse, shown, text
from sysid.models.complex_expressions import as_complex, by_numpy, is_complex
from sysid.structure.structure import Array

_PART = 0.05  # of its range: the least step of an unknown

# What is told of what CasADi cannot do, here and where a module's own line meets it.
NO_TRUTH = (
    "an expression in variables has no value yet, so it is neither true nor false: of lower <= k <= upper make two "
    "constraints, [lower <= k, k <= upper], and of `a and b` [a, b]; in the place of `if` give both cases, "
    "ca.if_else(k > 3, a, b), and of max(a, b) ca.fmax(a, b)"
)
NO_NUMBER = (
    "an expression in variables has no value yet, so it is no float or int: leave it as it is, CasADi's functions and "
    "NumPy's take it; what is known is a number of its own, or a Variable with fixed=True"
)
NO_CHANGE = "an entry of what is written in variables is not changed in place: write all entries, ca.vertcat(a, b, c)"
NO_COMPLEX = (
    "complex numbers meet an expression in variables, and CasADi has real ones only: a complex residual is "
    "sysid.real_and_imaginary(record - response); elsewhere write two real expressions, of a record as [record.real - "
    "real, record.imag - imag], of exp(-1j * a) as ca.cos(a) and -ca.sin(a); of a stiffness K * (1 + 1j * eta) give K, "
    "and damping=[eta / 2, ...], a ratio a mode"
)


def _same(x: Any) -> Any:
    """Identity, for what is searched on a linear scale."""
    return x


class Unknown:
    """A column of scalar unknowns of one name, as the matrix models state them.

    Parameters
    ----------
    name : str
        As tables and results call it, with underscores for spaces.
    lower, upper : array_like, shape (size,)
        Bounds of every search; equal where an entry is known.
    unit : str
        For tables.
    sampling : callable, optional
        CasADi expression of the swarm's coordinates (size,) to the unknowns, both in the box: where the swarm
        had better search another distribution than the uniform one (eq. 18 of the paper). Gradient methods never see
        it.
    unsampling : callable, optional
        Its inverse on numbers, (size,) to (size,).
    scale : str
        How the swarm spreads its candidates over the bounds, in a word: "linear", "log", "by row".
    relative : bool
        Only the ratios of its entries mean something, so that tables of results leave it out.
    box : pair of array_like (size,), optional
        Where candidates are drawn and a swarm searches, within the bounds; all that lies between them by default.
    note : str
        Why the box is where it is, for logs and remarks; empty where it is the usual one.

    Attributes
    ----------
    box : pair of (size,)
        Lower and upper ends of what a swarm searches.
    guess : (size,)
        Where a search may start: the middle of the box.
    has_guess, fixed : bool
        Whether the guess was stated, and whether the unknown is held at it; both only a `Variable`'s.

    Raises
    ------
    InputError
        Where bounds are reversed, infinite, or of two shapes.
    """

    has_guess = False
    fixed = False
    relative = False
    note = ""

    def __init__(
        self,
        name: str,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        unit: str = "",
        sampling: Callable[[ca.SX], ca.SX] = _same,
        unsampling: Callable[[Array], Array] = _same,
        scale: str = "linear",
        relative: bool = False,
        box: tuple[ArrayLike, ArrayLike] | None = None,
        note: str = "",
    ) -> None:
        self.name, self.unit, self.scale = text("the name of an Unknown", name), unit, scale
        refuse((not isinstance(unit, str), f"variable {name}: its unit {unit!r} is no text"))
        printable(f"variable {name}: unit", unit)
        self.relative = flag(f"variable {name}: relative", relative)
        self.lower = np.atleast_1d(finite_array(f"variable {name}: lower", lower))
        self.upper = np.atleast_1d(finite_array(f"variable {name}: upper", upper))
        if self.lower.shape != self.upper.shape or self.lower.ndim != 1:
            raise InputError(f"variable {name}: lower {self.lower.shape} and upper {self.upper.shape} disagree")
        if np.any(self.lower > self.upper):
            raise InputError(f"variable {name}: bounds must be finite with lower <= upper")
        self.shape: tuple[int, ...] = (self.lower.size,)
        self.sampling, self.unsampling, self.note = sampling, unsampling, note
        low, high = (finite_array(f"variable {name}: box", end) for end in box or (self.lower, self.upper))
        if low.shape != self.shape or high.shape != self.shape or np.any((low < self.lower) | (high > self.upper)):
            raise InputError(f"variable {name}: its box must lie within its bounds, entry by entry")
        self.box = low, high

    @cached_property
    def guess(self) -> Array:
        """The middle of the swarm's search space."""
        return np.asarray(self.sampled()(sum(self.box) / 2)).ravel()

    @property
    def size(self) -> int:
        """Number of scalar unknowns."""
        return int(self.lower.size)

    @property
    def title(self) -> str:
        """The name as messages and tables write it."""
        return self.name.replace("_", " ")

    @property
    def labels(self) -> tuple[str, ...]:
        """A name an entry, counted from 1: ``spring 1``."""
        return (self.title,) if self.size == 1 else tuple(f"{self.title} {i + 1}" for i in range(self.size))

    def sampled(self) -> ca.Function:
        """`sampling` as a function of numbers."""
        s = ca.SX.sym("s", self.size)
        return ca.Function("sampling", [s], [ca.densify(self.sampling(s))])

    def shaped(self, flat: Array) -> Array:
        """Numbers of its entries, column by column, as an array of its shape."""
        return np.reshape(flat, self.shape, order="F")


def _of_symbols(operation: Callable[..., Any]) -> Callable[..., Any]:
    """A method of `Variable` that carries out an operation on the symbols of what it is given."""
    return lambda *operands: operation(*map(expression_of, operands))


def _from_the_right(operation: Callable[..., Any]) -> Callable[..., Any]:
    """The same of two operands, the variable the second of them."""
    return lambda variable, other: operation(expression_of(other), variable.symbol)


def _closed(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of `Expression` that does as CasADi's, and gives an `Expression` or, beside complex numbers, a pair."""

    def closed(self: ca.MX, *others: Any) -> Any:
        if method.__name__ in _ARITHMETIC and any(map(is_complex, others)):
            return getattr(as_complex(self), method.__name__)(*others)
        refuse_complex(others)
        result = method(self, *map(expression_of, others))
        return Expression(result) if isinstance(result, ca.MX) else result

    return closed


_OPERATIONS = ("add", "sub", "mul", "truediv", "matmul")
_ARITHMETIC = {f"__{side}{name}__" for side in ("", "r") for name in _OPERATIONS}  # that complex numbers have


class Expression(ca.MX):
    """Expression in variables with operators: a CasADi MX that tells its author what CasADi cannot do.

    CasADi's functions give a plain MX; what is asked of that is told by `sysid.catalogue`, of a problem module alone.
    """

    def __bool__(self) -> bool:
        if self.is_constant():
            return bool(super().__bool__())
        raise InputError(f"{user_site()}: {NO_TRUTH}")

    def __float__(self) -> float:
        if self.is_constant():
            return float(super().__float__())
        raise InputError(f"{user_site()}: {NO_NUMBER}")

    def __int__(self) -> int:
        return int(float(self))

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if any(map(is_complex, inputs)):
            return by_numpy(ufunc, inputs)
        return _closed(lambda _, *given: ca.MX.__array_ufunc__(self, ufunc, method, *given, **options))(self, *inputs)

    __getitem__ = _closed(ca.MX.__getitem__)
    __neg__, __abs__ = _closed(ca.MX.__neg__), _closed(ca.MX.__abs__)
    __add__, __radd__ = _closed(ca.MX.__add__), _closed(ca.MX.__radd__)
    __sub__, __rsub__ = _closed(ca.MX.__sub__), _closed(ca.MX.__rsub__)
    __mul__, __rmul__ = _closed(ca.MX.__mul__), _closed(ca.MX.__rmul__)
    __truediv__, __rtruediv__ = _closed(ca.MX.__truediv__), _closed(ca.MX.__rtruediv__)
    __pow__, __rpow__ = _closed(ca.MX.__pow__), _closed(ca.MX.__rpow__)
    __matmul__, __rmatmul__ = _closed(ca.MX.__matmul__), _closed(ca.MX.__rmatmul__)
    __lt__, __le__ = _closed(ca.MX.__lt__), _closed(ca.MX.__le__)
    __gt__, __ge__ = _closed(ca.MX.__gt__), _closed(ca.MX.__ge__)
    __eq__, __ne__ = _closed(ca.MX.__eq__), _closed(ca.MX.__ne__)
    __hash__ = ca.MX.__hash__


def refuse_complex(operands: Iterable[Any]) -> None:
    """Refuse complex numbers, arrays of them and complex expressions too, where real ones are needed."""
    if any(map(is_complex, operands)):
        raise InputError(f"{user_site()}: {NO_COMPLEX}")


class Variable(Unknown):
    """A named unknown, or an array of them, of which matrices, residuals and constraints are written.

    Slices, operators, NumPy's ufuncs and CasADi's functions accept it: it stands for a CasADi MX symbol.

    Parameters
    ----------
    name : str
        As tables, messages and results call it; each name once in a problem.
    shape : int or tuple of int
        () for a scalar, n or (n,) for a column, (n, m) for a matrix.
    lower, upper : float or array_like
        The search space, broadcast to the shape; finite.
    guess : float or array_like, optional
        Where a search may start; the middle of the search space where none is given.
    log : bool
        The swarm searches it on a logarithmic scale (lower > 0): for what is known to an order of magnitude. IPOPT
        works in the variable itself, in units of its start.
    fixed : bool
        Held at `guess`, and no unknown: the way to try a variant with this quantity known.
    unit : str
        For tables.

    Attributes
    ----------
    declared : str
        File and line of its declaration.

    Raises
    ------
    InputError
        Where bounds are reversed, infinite or of another shape, or the guess is outside them.

    Examples
    --------
    >>> import casadi as ca
    >>> import sysid
    >>> k = sysid.Variable("storey stiffness", 3, lower=1e5, upper=1e7, log=True, unit="N/m")
    >>> K = ca.diag(k) + ca.diag(ca.vertcat(k[1:], 0))
    >>> K.shape
    (3, 3)
    """

    # NumPy leaves mixed arithmetic to the methods below.
    __array_priority__ = 2000.0
    # Comparison makes a constraint, so a variable is equal to itself only.
    __hash__ = object.__hash__

    def __init__(
        self,
        name: str,
        shape: int | Sequence[int] = (),
        *,
        lower: ArrayLike,
        upper: ArrayLike,
        guess: ArrayLike | None = None,
        log: bool = False,
        fixed: bool = False,
        unit: str = "",
    ) -> None:
        self.declared = user_site()
        if not isinstance(name, str) or not name:
            raise InputError(f"a Variable ({self.declared}) needs a name, and {shown(name)} is none")
        where = f"variable {name!r} ({self.declared})"
        self.name, self.unit = printable(f"the name of {where}", name), unit
        self.log, self.fixed = flag(f"{where}: log", log), flag(f"{where}: fixed", fixed)
        self._refuse_where((not isinstance(unit, str), f"its unit {unit!r} is no text"))
        printable(f"{where}: unit", unit)
        self.scale = "log" if log else "linear"
        self.shape = self._check_shape(shape)
        self.lower, self.upper = self.box = lower, upper = self._flat("lower", lower), self._flat("upper", upper)
        at = int(np.argmax(lower > upper))
        self._refuse_where(
            (
                not np.all(np.isfinite([lower, upper])),
                "its bounds are not all finite; the search space must be bounded (state the widest you believe)",
            ),
            (lower[at] > upper[at], f"its bounds are reversed: lower {lower[at]:g} is above upper {upper[at]:g}"),
            (
                not fixed and np.all(lower == upper),
                f"its bounds are equal ({lower[0]:g}): state fixed=True with a guess for what is known",
            ),
            (log and np.any(lower <= 0), f"log=True needs positive bounds, and lower is {lower.min():g}"),
            (fixed and guess is None, "fixed=True needs a guess, at which it is held"),
        )
        self.sampling, self.unsampling = log_sampling(lower, upper) if log else (_same, _same)
        middle = np.exp((np.log(lower) + np.log(upper)) / 2) if log else (lower + upper) / 2
        self.has_guess = guess is not None
        self.guess = given = np.clip(middle, lower, upper) if guess is None else self._flat("guess", guess)
        at = int(np.argmax((given < lower) | (given > upper)))
        self._refuse_where(
            (not np.all(np.isfinite(given)), "its guess is not finite"),
            (
                not lower[at] <= given[at] <= upper[at],
                f"its guess {given[at]:g} is outside the bounds {lower[at]:g} to {upper[at]:g}",
            ),
        )
        self.symbol = Expression(ca.MX.sym(self.name, *(*self.shape, 1, 1)[:2]))
        self.order = len(_declared)
        _declared[self.symbol.__hash__()] = self

    def _check_shape(self, shape: int | Sequence[int]) -> tuple[int, ...]:
        given = shape if isinstance(shape, tuple | list | np.ndarray) else (shape,)
        try:
            sizes = tuple(0 if isinstance(size, bool) else operator.index(size) for size in given)
        except TypeError:
            sizes = (0,)
        wrong = len(sizes) > 2 or any(size < 1 for size in sizes)
        self._refuse_where((wrong, f"its shape {shown(shape)} is not (), n or (n, m)"))
        return sizes

    def _flat(self, what: str, value: ArrayLike) -> Array:
        """Entries column by column, as CasADi has them."""
        array = numbers(f"variable {self.name!r} ({self.declared}): {what}", value)
        try:
            array = np.broadcast_to(array.reshape(self.shape) if isinstance(value, ca.DM) else array, self.shape)
        except ValueError:
            wrong = f"{what} = {shown(value)} is no number, nor numbers of its shape {self.shape}"
            self._refuse_where((True, wrong))
        return array.ravel(order="F").copy()

    def _refuse_where(self, *mistakes: tuple[Any, str]) -> None:
        refuse(*((applies, f"variable {self.name!r} ({self.declared}): {what}") for applies, what in mistakes))

    @property
    def title(self) -> str:
        """The name as it was given."""
        return self.name

    @property
    def labels(self) -> tuple[str, ...]:
        """A name an entry: ``k``, or ``k[0]``, or ``k[0,1]``, column by column."""
        if self.size == 1:
            return (self.name,)
        at = np.unravel_index(np.arange(self.size), self.shape, order="F")
        return tuple(f"{self.name}[{','.join(map(str, index))}]" for index in zip(*at, strict=True))

    def __repr__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        shape = "" if not self.shape else f", shape {self.shape}"
        return f"<Variable {self.name}: {self.lower.min():g} to {self.upper.max():g}{unit}{shape}>"

    # -- what makes it an expression --------------------------------------------------------------

    def __MX__(self) -> ca.MX:  # noqa: N802 - CasADi looks for this name
        return self.symbol

    def __getattr__(self, name: str) -> Any:
        # What Variable does not have itself, such as `.T`, is the symbol's.
        if name.startswith("_") or name == "symbol":
            raise AttributeError(name)
        return getattr(self.symbol, name)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        return self.symbol.__array_ufunc__(ufunc, method, *map(expression_of, inputs), **options)

    def __bool__(self) -> bool:
        return bool(self.symbol)

    def __float__(self) -> float:
        return float(self.symbol)

    def __int__(self) -> int:
        return int(self.symbol)

    def __setitem__(self, index: Any, value: Any) -> None:
        raise InputError(f"{user_site()}: {NO_CHANGE}")

    def __getitem__(self, index: Any) -> Any:
        try:
            return self.symbol[index]
        except RuntimeError:
            raise InputError(
                f"variable {self.name!r} ({self.declared}) has no entry [{index}]: its shape is {self.shape}"
            ) from None

    def __len__(self) -> int:
        if not self.shape:
            raise TypeError(f"variable {self.name!r} is a scalar and has no length")
        return self.shape[0]

    def __iter__(self) -> Any:
        return iter([self.symbol[i, :] for i in range(len(self))])

    __pos__, __neg__, __abs__ = _of_symbols(operator.pos), _of_symbols(operator.neg), _of_symbols(abs)
    __add__, __radd__ = _of_symbols(operator.add), _from_the_right(operator.add)
    __sub__, __rsub__ = _of_symbols(operator.sub), _from_the_right(operator.sub)
    __mul__, __rmul__ = _of_symbols(operator.mul), _from_the_right(operator.mul)
    __truediv__, __rtruediv__ = _of_symbols(operator.truediv), _from_the_right(operator.truediv)
    __pow__, __rpow__ = _of_symbols(operator.pow), _from_the_right(operator.pow)
    __matmul__, __rmatmul__ = _of_symbols(operator.matmul), _from_the_right(operator.matmul)
    __lt__, __le__ = _of_symbols(operator.lt), _of_symbols(operator.le)
    __gt__, __ge__ = _of_symbols(operator.gt), _of_symbols(operator.ge)
    __eq__, __ne__ = _of_symbols(operator.eq), _of_symbols(operator.ne)


# The one global of the package: a CasADi symbol knows no Python object, so this is how an expression's symbols lead
# back to the variables that they stand for. A variable is a few hundred bytes.
_declared: dict[int, Variable] = {}


def variable_of(symbol: ca.MX) -> Variable | None:
    """The variable that a symbol stands for; None for any other symbol."""
    return _declared.get(symbol.__hash__())


def declared() -> tuple[Variable, ...]:
    """All variables of this process, in the order of their declaration."""
    return tuple(_declared.values())


def expression_of(value: Any) -> Any:
    """The CasADi symbol of a variable; anything else as it is."""
    return value.symbol if isinstance(value, Variable) else value


def user_site() -> str:
    """Where the user's code called into the package, for messages: "file, line n"."""
    frame: FrameType | None = sys._getframe(1)
    # The package's own frames, and those of what carries out its cached properties; bundled problems are a user's code.
    while frame is not None and str(frame.f_globals.get("__name__", "")).split(".")[0] in ("sysid", "functools"):
        frame = frame.f_back
    return "?" if frame is None else f"{_short(frame.f_code.co_filename)}, line {frame.f_lineno}"


def _short(filename: str) -> str:
    """A path as the user would write it: from here where that is shorter."""
    try:
        return str(Path(filename).relative_to(Path.cwd()))
    except (ValueError, OSError):
        return filename


def log_sampling(lower: Array, upper: Array) -> tuple[Callable[[ca.SX], ca.SX], Callable[[Array], Array]]:
    """`sampling` and `unsampling` of an `Unknown` that is searched on a logarithmic scale; bounds may be equal."""
    width, span = upper - lower, np.log(upper / lower)
    wide, long = np.where(width > 0, width, 1.0), np.where(span > 0, span, 1.0)
    return lambda s: lower * ca.exp((s - lower) / wide * span), lambda x: lower + width * np.log(x / lower) / long


def scales_of(unknowns: Iterable[Unknown], x: Array) -> Array:
    """A large step of each unknown, (size of x,): its own size, or a part of its range where that is larger.

    Where a range spans decades it tells nothing about the unknown.
    """
    width = [np.zeros(v.size) if v.scale == "log" else v.box[1] - v.box[0] for v in unknowns]
    return np.maximum(np.abs(x), _PART * np.concatenate([np.zeros(0), *width]))


def lower_of(unknowns: Iterable[Unknown]) -> Array:
    """Lower bounds of all unknowns, one after the other."""
    return np.concatenate([np.zeros(0), *(v.lower for v in unknowns)])


def upper_of(unknowns: Iterable[Unknown]) -> Array:
    """Upper bounds of all unknowns, one after the other."""
    return np.concatenate([np.zeros(0), *(v.upper for v in unknowns)])


def slices_of(unknowns: Iterable[Unknown]) -> list[slice]:
    """Where each unknown stands in the vector of all."""
    ends = np.cumsum([0, *(unknown.size for unknown in unknowns)]).tolist()
    return [slice(a, b) for a, b in pairwise(ends)]


def by_name(unknowns: Iterable[Unknown], x: Array) -> dict[str, Array]:
    """Numbers of all unknowns as one array a name, in its shape."""
    unknowns = tuple(unknowns)
    return {v.name: v.shaped(part) for v, part in zip(unknowns, split(unknowns, x), strict=True)}


def split(unknowns: Iterable[Unknown], x: ca.SX | Array) -> list:
    """Cut a vector of all unknowns into one piece a name."""
    return [x[part] for part in slices_of(unknowns)]
