"""Expressions made again of a list of operations, as `sysid.problem.encoding` writes it, by CasADi's own operators.

The list may come from anybody: only operations of `sysid.problem.operations` are made, every number is checked, and
what is asked for is limited before it is made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from math import prod
from typing import Any

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.problem import operations

Tree = dict[str, Any]


def decode(tree: Tree, symbols: Sequence[ca.MX]) -> list[ca.MX]:
    """Give the expressions of a tree that `sysid.problem.encoding.encode` made, in symbols of the patterns of its own.

    Raises
    ------
    InputError
        Where anything in the tree is not as `encode` makes it, asks for more than the limits, or needs a linear solver
        that this CasADi does not have.
    """
    reader = None
    try:
        reader = _Reader(tree)
        *called, last = tree["functions"]
        for function in called:
            reader.add(function)
        parts = reader.matrices(last, symbols)
        # Its memory: what one evaluation keeps at a time.
        limited("memory of one evaluation", ca.Function("whole", list(symbols), parts).sz_w(), operations.LIMITS.memory)
    except InputError:
        raise
    except Exception as error:  # whatever CasADi and Python say of wrong numbers
        at = "" if reader is None else reader.place
        lines = str(error).strip().splitlines() or [""]
        raise InputError(f"its expressions are damaged{at} ({type(error).__name__}: {lines[-1]})") from error
    return parts


def limited(what: str, value: float, most: float) -> None:
    """Refuse what is larger than its limit."""
    if not value <= most:
        raise InputError(f"its expressions ask for too much: {what} is {value:.3g}, at most {most:.3g} is read")


@dataclass(frozen=True)
class _Called:
    """A function that can be called, and the multiplications that one evaluation takes."""

    function: ca.Function
    work: float


class _Reader:
    """Reads the functions of a tree in their order."""

    def __init__(self, tree: Tree) -> None:
        self.names: tuple[str, ...] = tuple(tree["names"])
        self.patterns = list(_patterns(_whole(tree["patterns"])))
        self.called: list[_Called] = []
        self.place = ""
        self._operations = 0
        self._stored = 0  # nonzeros of all patterns
        self._known: set[int] = set()
        for pattern in self.patterns:
            self.count_pattern(pattern)

    def count_operation(self, name: str) -> None:
        self.place = f" at operation {self._operations} ({name!r})"
        self._operations += 1
        limited("the number of operations", self._operations, operations.LIMITS.operations)

    def count_pattern(self, pattern: ca.Sparsity) -> None:
        """Patterns are kept once by CasADi, however many matrices have them."""
        key = ca.SharedObject.__hash__(pattern)
        if key not in self._known:
            self._known.add(key)
            self._stored += pattern.nnz()
            limited("the size of all patterns", self._stored, operations.LIMITS.stored)

    def pattern(self, number: int) -> ca.Sparsity:
        return _at(self.patterns, number)

    def add(self, tree: Tree) -> None:
        """Add a function that others call."""
        makers: dict[str, Callable[[Tree, str], _Called]] = {
            "mx": self._mx, "sx": self._sx, "map": self._map, "switch": self._switch,
        }  # fmt: skip
        make = makers.get(tree["kind"], self._interpolant)
        self.called.append(make(tree, f"f{len(self.called)}"))

    def inputs(self, tree: Tree) -> list[ca.Sparsity]:
        return [self.pattern(number) for number in _whole(tree["inputs"])]

    def matrices(self, tree: Tree, symbols: Sequence[ca.MX]) -> list[ca.MX]:
        """The outputs of a function on matrices, in some symbols."""
        return self._outputs(tree, symbols)[0]

    def _outputs(self, tree: Tree, symbols: Sequence[ca.MX]) -> tuple[list[ca.MX], float]:
        if tree["kind"] != "mx" or [one.sparsity() for one in symbols] != self.inputs(tree):
            raise ValueError("other inputs than those of the function")
        matrices = _Matrices(self, symbols, tree)
        matrices.read(_whole(tree["code"]))
        return [_at(matrices.values, number) for number in _whole(tree["outputs"])], matrices.work

    def _mx(self, tree: Tree, name: str) -> _Called:
        symbols = [ca.MX.sym(f"x{i}", pattern) for i, pattern in enumerate(self.inputs(tree))]
        outputs, work = self._outputs(tree, symbols)
        return _Called(ca.Function(name, symbols, outputs), work)

    def _sx(self, tree: Tree, name: str) -> _Called:
        inputs, code, numbers = self.inputs(tree), _whole(tree["code"]), iter(_numbers(tree))
        symbols = [ca.SX.sym(f"x{i}", pattern) for i, pattern in enumerate(inputs)]
        values = [one for symbol in symbols for one in symbol.nonzeros()]
        first, at = len(values), 0
        while at < len(code):
            operation = _at(self.names, code[at])
            self.count_operation(operation)
            count = operations.ENTRYWISE.get(operation, 0)
            arguments = [_at(values, number) for number in code[at + 1 : at + 1 + count]]
            if operation == "const":
                values.append(ca.SX(next(numbers)))
            else:
                values.append(_entrywise(ca.SX, operation, arguments))
            at += 1 + count
        limited("the size of a matrix", len(values), operations.LIMITS.entries)
        outputs, ends = _whole(tree["outputs"]), list[ca.SX]()
        at = 1 + outputs[0]
        for pattern in map(self.pattern, outputs[1:at]):
            entries = [_at(values, number) for number in outputs[at : at + pattern.nnz()]]
            at += pattern.nnz()
            ends.append(ca.SX(pattern, ca.vertcat(*entries)) if entries else ca.SX(pattern))
        return _Called(ca.Function(name, symbols, ends), len(values) - first)

    def _map(self, tree: Tree, name: str) -> _Called:
        number, count = _whole(tree["code"])
        one = _at(self.called, number)
        f = one.function
        sizes = [f.numel_in(i) for i in range(f.n_in())] + [f.numel_out(i) for i in range(f.n_out())]
        limited("the size of a matrix", max(sizes, default=1) * count, operations.LIMITS.entries)
        limited("the work of one evaluation", one.work * count, operations.LIMITS.work)
        return _Called(f.map(count), one.work * count)

    def _switch(self, tree: Tree, name: str) -> _Called:
        default, *others = (_at(self.called, number) for number in _whole(tree["code"]))
        function = ca.Function.conditional(name, [one.function for one in others], default.function)
        return _Called(function, max(one.work for one in (default, *others)))

    def _interpolant(self, tree: Tree, name: str) -> _Called:
        operations.check_library("interpolant", tree["kind"], tuple(operations.INTERPOLANTS))
        sizes, numbers = _whole(tree["code"]), _numbers(tree)
        ends = np.cumsum([0, *sizes])
        if not sizes or min(sizes) < 2 or len(sizes) > operations.LIMITS.axes or len(numbers) < ends[-1]:
            raise ValueError("no grid of an interpolant")
        grid = [numbers[a:b] for a, b in pairwise(ends)]
        function = ca.interpolant(name, tree["kind"], grid, numbers[ends[-1] :])
        return _Called(function, 4.0 ** len(sizes) * function.nnz_out())


class _Matrices:
    """The values of a function on matrices, one operation after the other."""

    def __init__(self, reader: _Reader, symbols: Sequence[ca.MX], tree: Tree) -> None:
        self.values: list[ca.MX] = list(symbols)
        self.work = 0.0
        self._reader, self._numbers = reader, _numbers(tree)
        self._used = 0  # numbers

    def read(self, code: Sequence[int]) -> None:
        """Make the values of all operations."""
        at = 0
        while at < len(code):
            name = _at(self._reader.names, code[at])
            self._reader.count_operation(name)
            numbers, at = _counted(code, at + 1)
            parameters, at = _counted(code, at)
            arguments = [_at(self.values, number) for number in numbers]
            values = self._evaluated(name, arguments, parameters)
            for value in values:
                limited("the size of a matrix", value.numel(), operations.LIMITS.entries)
                self._reader.count_pattern(value.sparsity())
                self._add_work(value.nnz())
            self.values += values

    def _add_work(self, work: float) -> None:
        self.work += work
        limited("the work of one evaluation", self.work, operations.LIMITS.work)

    def _evaluated(self, name: str, arguments: list[ca.MX], parameters: list[int]) -> Sequence[ca.MX]:
        if name in operations.ENTRYWISE:  # of which no result is larger than the largest argument
            _exactly(0, parameters)
            return [_entrywise(ca.MX, name, arguments)]
        self._check_size(name, arguments, parameters)
        if name in operations.MATRICES:
            count, of_parameters, make = operations.MATRICES[name]
            made = make(*_exactly(count, arguments), *_exactly(of_parameters, parameters))
            return made if isinstance(made, list) else [made]
        if name in operations.RESHAPING:
            return [operations.RESHAPING[name](*_exactly(1, arguments), self._reader.pattern(*parameters))]
        solver = name.partition(" ")[2]
        others: dict[str, Callable[[list[ca.MX], list[int]], list[ca.MX]]] = {
            "const": self._const, "getnonzeros": self._getnonzeros, "einstein": self._einstein, "call": self._call,
            "setnonzeros": partial(self._into, add=False), "addnonzeros": partial(self._into, add=True),
            f"solve {solver}".strip(): partial(self._solve, solver),
        }  # fmt: skip
        if name not in others:
            raise ValueError("no operation that this sysid knows")
        return others[name](arguments, parameters)

    def _check_size(self, name: str, arguments: list[ca.MX], parameters: list[int]) -> None:
        """Refuse what would be too large, or take too long, before it is made."""
        kind, rows, columns = name.partition(" ")[0], *([one.size(axis) for one in arguments] for axis in (1, 2))
        sizes, nonzeros = [one.numel() for one in arguments], [one.nnz() for one in arguments]
        n, wide = max(rows, default=0), max(columns, default=0)
        entries = {
            "vertcat": sum(rows) * wide, "horzcat": n * sum(columns), "diagcat": sum(rows) * sum(columns),
            "kron": prod(sizes[:2]), "horzrepmat": max(sizes, default=0) * max(parameters, default=0), "solve": n**2,
        }.get(kind, 0)  # fmt: skip
        work = {"determinant": n**3, "solve": n**2 * (n + max([1, *columns[:1]]))}.get(kind, max(nonzeros, default=0))
        if kind == "mtimes":
            work = min(nonzeros[1] * columns[2], rows[1] * nonzeros[2])
        limited("the size of a matrix", entries, operations.LIMITS.entries)
        self._add_work(work)

    def _solve(self, solver: str, arguments: list[ca.MX], parameters: list[int]) -> list[ca.MX]:
        b, a = _exactly(2, arguments)
        return [operations.linear_solve(solver, b, a, transposed=bool(*_exactly(1, parameters)))]

    def _const(self, arguments: list[ca.MX], parameters: list[int]) -> list[ca.MX]:
        pattern, one = self._reader.pattern(parameters[0]), bool(parameters[1])
        count = 1 if one else pattern.nnz()
        numbers = self._numbers[self._used : self._used + count]
        self._used += count
        if len(numbers) != count:
            raise ValueError("numbers are missing")
        if one and np.isnan(numbers[0]):  # CasADi keeps equal numbers once, but not these, which differ from themselves
            return [ca.MX.nan(pattern)]
        values = numbers * (pattern.nnz() if one else 1)
        return [ca.MX(ca.DM(pattern, values)) if values else ca.MX(pattern)]

    def _getnonzeros(self, arguments: list[ca.MX], parameters: list[int]) -> list[ca.MX]:
        pattern = self._reader.pattern(parameters[0])
        (x,) = _exactly(1, arguments)
        return [operations.get_nonzeros(x, pattern, _places(parameters[1:]))]

    def _into(self, arguments: list[ca.MX], parameters: list[int], *, add: bool) -> list[ca.MX]:
        y, x = _exactly(2, arguments)
        return [operations.set_nonzeros(y, x, _places(parameters), add=add)]

    def _einstein(self, arguments: list[ca.MX], parameters: list[int]) -> list[ca.MX]:
        lists, at = list[list[int]](), 0
        while at < len(parameters):
            one, at = _counted(parameters, at)
            lists.append(one)
        sizes = dict(zip((*lists[3], *lists[4]), (*lists[0], *lists[1]), strict=True))
        self._add_work(float(np.prod([*sizes.values()], dtype=float)))
        c, a, b = _exactly(3, arguments)
        return [operations.einstein(c, a, b, _exactly(6, lists))]

    def _call(self, arguments: list[ca.MX], parameters: list[int]) -> list[ca.MX]:
        called = _at(self._reader.called, *_exactly(1, parameters))
        self._add_work(called.work)
        function = called.function
        patterns = [function.sparsity_in(i) for i in range(function.n_in())]
        if [one.sparsity() for one in arguments] != patterns:
            raise ValueError("an argument has another pattern than the function's")
        return list(function.call(arguments, False, True))


def _patterns(numbers: list[int]) -> Iterator[ca.Sparsity]:
    """The patterns of a list of them: see `sysid.problem.encoding`."""
    at = 0
    while at < len(numbers):
        rows, columns, dense = numbers[at : at + 3]
        if rows < 0 or columns < 0:
            raise ValueError("a matrix has a negative size")
        limited("the size of a matrix", rows * columns, operations.LIMITS.entries)
        limited("the size of a matrix", max(rows, columns), operations.LIMITS.entries)
        at += 3
        if dense:
            yield ca.Sparsity.dense(rows, columns)
            continue
        count = numbers[at]
        starts, within = numbers[at + 1 : at + columns + 2], numbers[at + columns + 2 : at + columns + 2 + count]
        at += columns + 2 + count
        _check_pattern(rows, np.array(starts, dtype=np.int64), np.array(within, dtype=np.int64), columns, count)
        yield ca.Sparsity(rows, columns, starts, within)


def _check_pattern(rows: int, starts: Any, within: Any, columns: int, count: int) -> None:
    """Refuse a pattern with which CasADi would read beyond its arrays."""
    if count < 0 or starts.size != columns + 1 or within.size != count:
        raise ValueError("a pattern is cut")
    if starts[0] != 0 or starts[-1] != count or np.any(np.diff(starts) < 0):
        raise ValueError("the columns of a pattern do not follow each other")
    rising = np.ones(max(count - 1, 0), dtype=bool)
    rising[starts[(starts > 0) & (starts < count)] - 1] = False  # from one column to the next
    if count and (within.min() < 0 or within.max() >= rows or np.any(np.diff(within)[rising] <= 0)):
        raise ValueError("the rows of a pattern do not rise")


def _entrywise(kind: Any, name: str, arguments: Sequence[Any]) -> Any:
    """An operation on each entry of matrices (MX), or on numbers (SX)."""
    count = operations.ENTRYWISE.get(name)
    if count is None:
        raise ValueError("no operation on numbers")
    make = kind.unary if count == 1 else kind.binary
    return make(operations.casadi_number(name), *_exactly(count, arguments))


def _counted(code: Sequence[int], at: int) -> tuple[list[int], int]:
    """Numbers behind their count, and where the next thing stands."""
    count = code[at]
    if not 0 <= count < len(code) - at:
        raise ValueError("the list is cut")
    return list(code[at + 1 : at + 1 + count]), at + 1 + count


def _places(parameters: Sequence[int]) -> list[int]:
    """Places of nonzeros: see `_places` of `sysid.problem.encoding`."""
    if parameters[0] == 0:
        return list(parameters[1:])
    first, step, count = _exactly(3, parameters[1:])
    limited("the size of a matrix", count, operations.LIMITS.entries)
    return [first + step * i for i in range(count)]


def _exactly(count: int | None, values: Sequence[Any]) -> Sequence[Any]:
    """Values, refused where they are not so many; None is any number."""
    if len(values) != count and count is not None:
        raise ValueError(f"{len(values)} of {count} arguments or parameters")
    return values


def _at(values: Sequence[Any], number: int) -> Any:
    """A value by its number, which may be wrong."""
    if not 0 <= number < len(values):
        raise ValueError(f"{number} is not among {len(values)} values")
    return values[number]


def _whole(numbers: Any) -> list[int]:
    """Whole numbers of an array as Python's, which do not overflow."""
    values = np.asarray(numbers)
    if values.ndim != 1 or (values.size and values.dtype.kind not in "iu"):
        raise ValueError("whole numbers are needed")
    return [int(value) for value in values.tolist()]


def _numbers(tree: Tree) -> list[float]:
    values = np.asarray(tree["numbers"])
    if values.ndim != 1 or values.dtype != float:
        raise ValueError("numbers are needed")
    return [float(value) for value in values.tolist()]
