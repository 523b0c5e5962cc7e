"""Expressions as a list of operations in plain data; `sysid.problem.decoding` makes them again.

::

    names       operations that occur, in words
    patterns    sparsity patterns, one after the other: rows, columns, 1 where dense, else 0, nonzeros, the starts of
                the columns, and the row of each nonzero
    functions   those that are called, each before the first that calls it; the expressions themselves are the last

A function has a kind, the patterns of its inputs, its outputs, integers and numbers. An "mx" function is a list of
operations on matrices: the number of the operation among the names, how many arguments, the arguments, how many
parameters, the parameters. Arguments are values by their numbers: the inputs first, then what each operation made, in
their order. An "sx" function is the same with numbers in the place of matrices, without the counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.problem import operations
from sysid.problem.decoding import Tree, decode
from sysid.problem.operations import interpolant_data, interpolant_options, is_compiled
from sysid.structure.structure import Array

_NAMES = {operations.casadi_number(name): name for name in (*operations.NAMES, "input", "output")}
_CLASSES = {kind: name for name, kind in operations.INTERPOLANTS.items()}


class NotStorableError(InputError):
    """An expression holds what a file cannot; the message begins with the operation."""


def encode(symbols: Sequence[ca.MX], expressions: Sequence[ca.MX], points: Sequence[Sequence[Array]]) -> Tree:
    """Give expressions of some symbols as plain data, which was read again and compared.

    At each of the `points`, values of all symbols, values and Jacobian of what is read again are the same to the bit.

    Raises
    ------
    NotStorableError
        Where an operation cannot be stored, or what is read again is not the same.
    """
    writer = _Writer()
    writer.add_mx(symbols, expressions)
    tree = writer.tree()
    try:
        again = decode(tree, symbols)
    except InputError as error:
        raise NotStorableError(str(error)) from error
    differing = _differing(symbols, expressions, again, points)
    if differing:
        raise NotStorableError(f"its operations, read again, give other {differing}")
    return tree


def _differing(
    symbols: Sequence[ca.MX], first: Sequence[ca.MX], again: Sequence[ca.MX], points: Sequence[Sequence[Array]]
) -> str:
    """In a word what of two lists of expressions is not the same; empty where all is."""
    if [one.sparsity() for one in first] != [one.sparsity() for one in again]:
        return "patterns"
    of_first, of_again = _with_slopes(symbols, first), _with_slopes(symbols, again)
    for point in points:
        for what, mine, other in zip(("values", "derivatives"), of_first(*point), of_again(*point), strict=True):
            if mine.sparsity() != other.sparsity() or not _same_bits(mine, other):
                return what
    return ""


def _with_slopes(symbols: Sequence[ca.MX], expressions: Sequence[ca.MX]) -> ca.Function:
    """Symbols to the entries of expressions, and their Jacobian; without it where an operation has no derivative."""
    rows = ca.vertcat(*(ca.vec(ca.densify(one)) for one in expressions))
    try:
        slopes = ca.jacobian(rows, ca.vertcat(*map(ca.vec, symbols)))
    except RuntimeError:
        slopes = ca.MX()
    return ca.Function("compared", symbols, [rows, slopes])


def _same_bits(mine: ca.DM, other: ca.DM) -> bool:
    a, b = (np.array(one.nonzeros(), dtype=float) for one in (mine, other))
    both = np.isnan(a) & np.isnan(b)  # which has many patterns of bits
    return bool(np.all((a.view(np.int64) == b.view(np.int64)) | both))


class _Writer:
    """Collects names, patterns and functions."""

    def __init__(self) -> None:
        self._names: dict[str, int] = {}
        self._patterns: dict[int, tuple[int, ca.Sparsity]] = {}  # numbers by CasADi's key, which lives as its pattern
        self._written: list[int] = []
        self._functions: list[Tree] = []
        self._numbers: dict[int, tuple[int, ca.Function]] = {}  # of functions likewise

    def tree(self) -> Tree:
        return {"names": tuple(self._names), "patterns": _integers(self._written), "functions": self._functions}

    def name(self, name: str) -> int:
        return self._names.setdefault(name, len(self._names))

    def pattern(self, pattern: ca.Sparsity) -> int:
        key = ca.SharedObject.__hash__(pattern)
        if key not in self._patterns:
            self._patterns[key] = len(self._patterns), pattern
            self._written += [*pattern.shape, int(pattern.is_dense())]
            if not pattern.is_dense():
                self._written += [pattern.nnz(), *pattern.colind(), *pattern.row()]
        return self._patterns[key][0]

    def add(
        self, kind: str, inputs: Sequence[ca.Sparsity], outputs: Sequence[int], code: Sequence[int], numbers: Any
    ) -> None:
        self._functions.append({
            "kind": kind, "inputs": _integers([self.pattern(one) for one in inputs]), "outputs": _integers(outputs),
            "code": _integers(code), "numbers": np.array(numbers, dtype=float),
        })  # fmt: skip

    def function(self, function: ca.Function) -> int:
        """Number of a function that is called."""
        key = function.__hash__()
        if key not in self._numbers:
            self._add_function(function)
            self._numbers[key] = len(self._functions) - 1, function
        return self._numbers[key][0]

    def _add_function(self, function: ca.Function) -> None:
        kind, name = function.class_name(), function.name()
        inputs = [function.sparsity_in(i) for i in range(function.n_in())]
        if kind in ("MXFunction", "SXFunction") and is_compiled(function):
            raise NotStorableError(f"the function {name!r}, which is compiled (jit)")
        if kind == "MXFunction":
            symbols = [ca.MX.sym(f"x{i}", pattern) for i, pattern in enumerate(inputs)]
            try:
                outputs = function.call(symbols, True, False)
            except RuntimeError:
                raise NotStorableError(f"the function {name!r}, which cannot be inlined") from None
            self.add_mx(symbols, outputs)
        elif kind == "SXFunction":
            _add_sx(self, function, inputs)
        elif kind == "Map":
            info = function.info()
            self.add("map", inputs, [], [self.function(info["f"]), info["n"]], [])
        elif kind == "Switch":
            info = function.info()
            self.add("switch", inputs, [], [self.function(one) for one in (info["f_def"], *info["f"])], [])
        elif kind in _CLASSES:
            _add_interpolant(self, function, inputs)
        else:
            raise NotStorableError(f"the function {name!r} ({kind})")

    def add_mx(self, symbols: Sequence[ca.MX], expressions: Sequence[ca.MX]) -> None:
        """Add a function on matrices."""
        leaves, joins, ends = _taken_apart(expressions)
        function = ca.Function("expressions", list(symbols), leaves)
        matrices = _Matrices(self, len(symbols))
        values = matrices.operations(function, len(leaves))
        for join in joins:
            operation, parameters = matrices.described(join.name, join.node)
            values.append(matrices.record(operation, [values[i] for i in join.arguments], parameters, 1))
        inputs = [symbol.sparsity() for symbol in symbols]
        self.add("mx", inputs, [values[i] for i in ends], matrices.code, matrices.numbers)


class _Matrices:
    """The operations of one function on matrices."""

    def __init__(self, writer: _Writer, inputs: int) -> None:
        self.writer, self.code, self.numbers, self._values = writer, list[int](), list[float](), inputs

    def record(self, name: str, arguments: Sequence[int], parameters: Sequence[int], outputs: int) -> int:
        """Add an operation; the number of the first value that it makes."""
        self.code += [self.writer.name(name), len(arguments), *arguments, len(parameters), *parameters]
        self._values += outputs
        return self._values - outputs

    def operations(self, function: ca.Function, outputs: int) -> list[int]:
        """Add all operations of a function; the values that are its outputs."""
        held: dict[int, int] = {}  # values by CasADi's places in its memory, which it uses again
        # CasADi has no operation for an output without nonzeros.
        empty = [i for i in range(outputs) if not function.nnz_out(i)]
        ends = dict.fromkeys(range(outputs), 0)
        ends |= {i: self.record("const", [], [self.writer.pattern(function.sparsity_out(i)), 0], 1) for i in empty}
        for k in range(function.n_instructions()):
            number, target = function.instruction_id(k), function.instruction_output(k)
            name, source = _NAMES.get(number), function.instruction_input(k)
            if name == "input":
                held[target[0]] = source[0]
            elif name == "output":
                ends[target[0]] = held[source[0]]
            elif name is None:
                raise NotStorableError(f"the operation {operations.casadi_name(number)!r}")
            else:
                operation, parameters = self.described(name, function.instruction_MX(k))
                first = self.record(operation, [held[i] for i in source], parameters, len(target))
                held |= {place: first + i for i, place in enumerate(target) if place >= 0}
        return list(ends.values())

    def described(self, name: str, node: ca.MX) -> tuple[str, list[int]]:
        """The name of an operation in the file, and its parameters."""
        if name in operations.WITHOUT_PARAMETERS:
            return name, []
        if name in operations.RESHAPING:
            return name, [self.writer.pattern(node.sparsity())]
        if name == "solve":
            return _solve_in_words(node)
        parameters: Callable[[ca.MX], list[int]] = getattr(self, f"_{_PARAMETERS.get(name, name)}")
        return name, parameters(node)

    def _const(self, node: ca.MX) -> list[int]:
        values = np.array(node.to_DM().nonzeros(), dtype=float)
        one = values.size > 1 and len({value.tobytes() for value in values}) == 1
        self.numbers += values[:1].tolist() if one else values.tolist()
        return [self.writer.pattern(node.sparsity()), int(one)]

    def _getnonzeros(self, node: ca.MX) -> list[int]:
        return [self.writer.pattern(node.sparsity()), *_places(node)]

    def _setnonzeros(self, node: ca.MX) -> list[int]:
        return _places(node)

    def _split(self, node: ca.MX) -> list[int]:
        pieces, name = node.info()["output"], _NAMES[node.op()]
        shapes = [pieces.size_out(i) for i in range(pieces.n_out())]
        ends = np.cumsum([(0, 0), *shapes], axis=0, dtype=int)
        chosen = {"vertsplit": ends[:, 0], "horzsplit": ends[:, 1], "diagsplit": ends}[name]
        return [int(end) for end in chosen.ravel()]

    def _repeat(self, node: ca.MX) -> list[int]:
        few, many = sorted((node.size2(), node.dep().size2()))
        if not few:
            raise NotStorableError("the repetition of a matrix without columns")
        return [many // few]

    def _einstein(self, node: ca.MX) -> list[int]:
        info = node.info()
        lists = [info[name] for name in ("dim_a", "dim_b", "dim_c", "a", "b", "c")]
        return [part for one in lists for part in (len(one), *one)]

    def _call(self, node: ca.MX) -> list[int]:
        return [self.writer.function(node.which_function())]


_PARAMETERS = {
    "addnonzeros": "setnonzeros", "vertsplit": "split", "horzsplit": "split", "diagsplit": "split",
    "horzrepmat": "repeat", "horzrepsum": "repeat",
}  # fmt: skip


@dataclass
class _Join:
    """A join at the end of an expression; its arguments are numbers of leaves, then of joins."""

    name: str
    node: ca.MX
    arguments: list[int] = field(default_factory=list)


_AT_ENDS = (*operations.JOINING, "reshape", "sparsity_cast")


def _taken_apart(expressions: Sequence[ca.MX]) -> tuple[list[ca.MX], list[_Join], list[int]]:
    """Expressions without the joins at their ends, these joins, and where each expression is among both.

    A function of CasADi's tells such a join not as an operation but as pieces of an output.
    """
    leaves: list[ca.MX] = []
    joins: list[_Join] = []
    found: dict[int, tuple[bool, int]] = {}  # by CasADi's key: whether it is a join, and its number
    waiting = [(one, False) for one in reversed(expressions)]
    while waiting:
        one, parts_are_done = waiting.pop()
        key, name = one.__hash__(), _NAMES.get(one.op())
        if key in found:
            continue
        if name not in _AT_ENDS:
            found[key] = (False, len(leaves))
            leaves.append(one)
        elif parts_are_done:
            found[key] = (True, len(joins))
            joins.append(_Join(name, one))
        else:
            waiting += [(one, True), *((one.dep(i), False) for i in reversed(range(one.n_dep())))]

    def place(one: ca.MX) -> int:
        is_join, number = found[one.__hash__()]
        return number + is_join * len(leaves)

    for join in joins:
        join.arguments = [place(join.node.dep(i)) for i in range(join.node.n_dep())]
    return leaves, joins, [place(one) for one in expressions]


def _places(node: ca.MX) -> list[int]:
    """Places of nonzeros: 1, the first, step and count of a row of them; else 0 and all of them."""
    places = [int(place) for place in node.mapping().nonzeros()]
    steps = np.unique(np.diff(places))
    if len(places) > 2 and steps.size == 1:
        return [1, places[0], int(steps[0]), len(places)]
    return [0, *places]


def _solve_in_words(node: ca.MX) -> tuple[str, list[int]]:
    """The solver of a node, which CasADi tells in no other way than its text."""
    symbols = [ca.MX.sym("b", node.dep(0).sparsity()), ca.MX.sym("a", node.dep(1).sparsity())]
    solve = ca.Function("solve", symbols, ca.graph_substitute([node], [node.dep(0), node.dep(1)], symbols))
    transposed = bool(node.info()["tr"])
    for solver in ("", *operations.SOLVERS):
        try:
            same = ca.Function("solve", symbols, [operations.linear_solve(solver, *symbols, transposed=transposed)])
        except (ValueError, RuntimeError):
            continue
        if solve.serialize() == same.serialize():  # node by node and option by option
            return f"solve {solver}".strip(), [int(transposed)]
    raise NotStorableError("the operation 'solve', by a linear solver with options or of another kind")


def _add_interpolant(writer: _Writer, function: ca.Function, inputs: Sequence[ca.Sparsity]) -> None:
    kind = _CLASSES[function.class_name()]
    grid, values = interpolant_data(function)
    same = all(grid) and bool(values)
    if same:
        again = ca.interpolant("again", kind, grid, values)
        same = interpolant_options(function) == interpolant_options(again) and _same_values(function, again, grid)
    if not same:
        raise NotStorableError(f"the function {function.name()!r} ({function.class_name()} with options or parameters)")
    numbers = [*(number for axis in grid for number in axis), *values]
    writer.add(kind, inputs, [], [len(axis) for axis in grid], numbers)


def _same_values(one: ca.Function, other: ca.Function, grid: Sequence[Sequence[float]], points: int = 200) -> bool:
    """True where two interpolants are the same to the bit at points all over their grid, and beyond its ends."""
    share = np.random.default_rng(0).uniform(-0.1, 1.1, (len(grid), points))
    ends = np.array([(axis[0], axis[-1]) for axis in grid])
    at = ca.DM(ends[:, :1] + share * np.diff(ends, axis=1))
    return one.size_in(0) == other.size_in(0) and _same_bits(one.map(points)(at), other.map(points)(at))


def _add_sx(writer: _Writer, function: ca.Function, inputs: Sequence[ca.Sparsity]) -> None:
    """Add a function on numbers."""
    starts = np.cumsum([0, *(pattern.nnz() for pattern in inputs)])
    outputs = [function.sparsity_out(i) for i in range(function.n_out())]
    targets = np.cumsum([0, *(pattern.nnz() for pattern in outputs)])
    code, numbers, count = list[int](), list[float](), int(starts[-1])
    held: dict[int, int] = {}
    ends = [0] * int(targets[-1])
    for k in range(function.n_instructions()):
        number, source, target = (
            function.instruction_id(k), function.instruction_input(k), function.instruction_output(k),
        )  # fmt: skip
        name = _NAMES.get(number, "")
        if name == "input":
            held[target[0]] = int(starts[source[0]]) + source[1]
        elif name == "output":
            ends[int(targets[target[0]]) + target[1]] = held[source[0]]
        elif name == "const" or name in operations.UNARY or name in operations.BINARY:
            if name == "const":
                numbers.append(function.instruction_constant(k))
            code += [writer.name(name), *(held[i] for i in source)]
            held[target[0]] = count
            count += 1
        else:
            raise NotStorableError(
                f"the operation {operations.casadi_name(number)!r} in the function {function.name()!r}"
            )
    writer.add("sx", inputs, [len(outputs), *map(writer.pattern, outputs), *ends], code, numbers)


def _integers(values: Sequence[int]) -> Array:
    """Integers in the shortest type that holds all of them."""
    least, most = min([*values, 0]), max([*values, 0])
    return np.array(values, dtype=np.promote_types(np.min_scalar_type(least), np.min_scalar_type(most)))
