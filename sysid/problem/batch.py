"""CasADi functions of one candidate over many candidates at once, on CasADi's own virtual machine."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from sysid.structure.structure import Array

CHUNK = 64  # candidates a compiled call: fixed, so that the bits do not depend on the swarm's size
_MOST_INSTRUCTIONS = 50_000  # of a function that is replayed, which takes some ten microseconds each to set up


class Batch:
    """A CasADi function of one candidate, over a chunk of candidates at once and without conversions.

    A function in scalar operations is replayed for all candidates of the chunk in step (`elementwise`), another is
    called for one after the other. What a candidate gives does not depend on the others, to the last bit. An instance
    is for one thread at a time; ``copy`` makes one for another thread.

    Parameters
    ----------
    function : casadi.Function
        Dense; of the arrays of one candidate.
    threads : int
        CasADi's own, where candidates are taken one by one; 0 for none.
    count : int
        Candidates a chunk.
    """

    def __init__(self, function: ca.Function, threads: int = 0, count: int = CHUNK) -> None:
        self.count = count
        self._sizes = [function.size_in(i) for i in range(function.n_in())]
        self._sizes_out = [function.size_out(i) for i in range(function.n_out())]
        self._in_step = _is_scalar(function)
        if self._in_step:
            self._compiled = elementwise(function, count)
        else:
            self._compiled = function.map(count, "thread", threads) if threads else function.map(count)
        self._allocate()

    def __copy__(self) -> Batch:
        """The same compiled function with memory of its own."""
        other = object.__new__(Batch)
        other.__dict__.update(self.__dict__)
        other._allocate()
        return other

    def _allocate(self) -> None:
        """Memory of inputs and outputs, which CasADi reads and writes in place."""
        self._buffer, self._run = self._compiled.buffer()
        self._given = [self._place(size) for size in self._sizes]
        self._made = [self._place(size) for size in self._sizes_out]
        for i, array in enumerate(self._given):
            self._buffer.set_arg(i, array.base.data)
        for i, array in enumerate(self._made):
            self._buffer.set_res(i, array.base.data)

    def _place(self, size: tuple[int, int]) -> Array:
        """Memory of one input or output of the chunk, seen as (count, rows, columns)."""
        rows, columns = size
        if self._in_step:  # all candidates of an entry side by side, entries column by column
            return np.zeros((columns, rows, self.count)).transpose(2, 1, 0)
        return np.zeros((self.count, columns, rows)).transpose(0, 2, 1)

    def __call__(self, *arrays: Array) -> list[Array]:
        """Outputs (count, rows, columns) of inputs (count, rows) or (count, rows, columns), count up to the chunk's."""
        count = len(arrays[0])
        for place, array in zip(self._given, arrays, strict=True):
            place[:count] = array.reshape(count, *place.shape[1:])
            place[count:] = place[count - 1]  # the last one again and again fills the chunk
        self._run()
        return [np.array(made[:count], order="C") for made in self._made]


def elementwise(function: ca.Function, count: int) -> ca.Function:
    """A function in scalar operations (SX) as one of `count` candidates, each of its operations done for all at once.

    CasADi's virtual machine then spends its time on numbers, not on reading instructions.

    Parameters
    ----------
    function : casadi.Function
        Of one candidate; inputs and outputs of any shape.
    count : int

    Returns
    -------
    casadi.Function
        Of matrices (count, entries), a column an entry of an input; to the same of the outputs.
    """
    inputs = [ca.MX.sym(f"i{i}", count, function.nnz_in(i)) for i in range(function.n_in())]
    columns = [ca.horzsplit(symbol) if symbol.numel() else [] for symbol in inputs]
    outputs = [[ca.MX()] * function.nnz_out(i) for i in range(function.n_out())]
    work = [ca.MX()] * function.sz_w()
    for k in range(function.n_instructions()):
        operation, read, write = (of(k) for of in (function.instruction_id, function.instruction_input,
                                                   function.instruction_output))  # fmt: skip
        if operation == ca.OP_INPUT:
            work[write[0]] = columns[read[0]][read[1]]
        elif operation == ca.OP_OUTPUT:
            made = work[read[0]]
            outputs[write[0]][write[1]] = made if made.numel() == count else ca.repmat(made, count)
        elif operation == ca.OP_CONST:
            work[write[0]] = ca.MX(function.instruction_constant(k))
        elif len(read) == 1:
            work[write[0]] = ca.MX.unary(operation, work[read[0]])
        else:
            work[write[0]] = ca.MX.binary(operation, work[read[0]], work[read[1]])
    return ca.Function(function.name(), inputs, [ca.horzcat(ca.MX(count, 0), *part) for part in outputs])


def _is_scalar(function: ca.Function) -> bool:
    """Whether a function is all scalar operations, and not too many to be replayed."""
    if not function.is_a("SXFunction") or function.n_instructions() > _MOST_INSTRUCTIONS:
        return False
    return all(function.instruction_id(k) != ca.OP_CALL for k in range(function.n_instructions()))


def in_chunks(function: Callable[[Array], Array], particles: Array) -> Array:
    """A function of a chunk of candidates over all of them."""
    return np.concatenate([function(particles[at : at + CHUNK]) for at in range(0, len(particles), CHUNK)])


def expanded(function: ca.Function) -> ca.Function:
    """The same in scalar operations where all of it can be: several times faster for small matrices."""
    try:
        return function.expand()
    except RuntimeError:  # a linear solver or an interpolant inside has no scalar form
        return function
