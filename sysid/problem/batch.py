"""CasADi functions of one candidate over many candidates at once, on CasADi's own virtual machine."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain

import casadi as ca
import numpy as np

from sysid.structure.structure import Array

CHUNK = 64  # candidates a call by lines: fixed, so that the bits do not depend on the swarm's size
_IN_STEP = 128  # candidates that go in step: with more, the virtual machine's memory leaves a processor's cache


class Batch:
    """A CasADi function of one candidate over many candidates, without conversions.

    A function in scalar operations is replayed for a chunk of candidates in step (`elementwise`), another is called
    for one after the other. What a candidate gives does not depend on the others, to the last bit. An instance
    is for one thread at a time; ``copy`` makes one for another thread.

    Parameters
    ----------
    function : casadi.Function
        Of the arrays of one candidate, dense.
    threads : int
        CasADi's own, where candidates are taken one by one; 0 for none.
    """

    def __init__(self, function: ca.Function, threads: int = 0) -> None:
        self._in_step = _is_scalar(function)
        self._chunk = _IN_STEP if self._in_step else CHUNK
        if self._in_step:
            function = _without_zeros(function)
            self._compiled = elementwise(function, self._chunk)
        else:
            self._compiled = function.map(self._chunk, "thread", threads) if threads else function.map(self._chunk)
        self._inputs = [function.sparsity_in(i) for i in range(function.n_in())]
        self._outputs = [function.sparsity_out(i) for i in range(function.n_out())]
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
        self._given, read = self._places(self._inputs)
        self._results, written = self._places(self._outputs)
        for i, memory in enumerate(read):
            self._buffer.set_arg(i, memory.data)
        for i, memory in enumerate(written):
            self._buffer.set_res(i, memory.data)

    def _places(self, matrices: list[ca.Sparsity]) -> tuple[list[Array], list[Array]]:
        """Memory of inputs or outputs of a chunk, seen as (candidates, rows, columns); and that of each part."""
        if not self._in_step:
            memory = [np.zeros((self._chunk, *matrix.shape[::-1])) for matrix in matrices]
            return [array.swapaxes(1, 2) for array in memory], memory
        # A power of two between entries would put them in the same lines of a cache.
        places = [np.zeros((*matrix.shape, self._chunk + 8))[..., : self._chunk] for matrix in matrices]
        entries = [place[i, j] for place, matrix in zip(places, matrices, strict=True)
                   for i, j in zip(*matrix.get_triplet(), strict=True)]  # fmt: skip
        return [np.moveaxis(place, -1, 0) for place in places], entries

    def __call__(self, *arrays: Array) -> list[Array]:
        """Outputs (count, rows, columns) of inputs (count, rows) or (count, rows, columns)."""
        outputs = [np.empty((len(arrays[0]), *matrix.shape)) for matrix in self._outputs]
        for start in range(0, len(arrays[0]), self._chunk):
            chunk = slice(start, start + self._chunk)
            for place, array in zip(self._given, arrays, strict=True):
                part = array[chunk]
                place[: len(part)] = part.reshape(len(part), *place.shape[1:])
                place[len(part) :] = place[len(part) - 1]  # the last one fills up the chunk
            self._run()
            for output, result in zip(outputs, self._results, strict=True):
                output[chunk] = result[: len(output[chunk])]
        return outputs


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
        Of columns (count,), one an entry of an input, one input after the other; to the same of the outputs. Columns of
        their own because the virtual machine then reads and writes each where it is needed, and holds fewer.
    """
    inputs = [[ca.MX.sym("i", count) for _ in range(function.nnz_in(i))] for i in range(function.n_in())]
    outputs = [[ca.MX()] * function.nnz_out(i) for i in range(function.n_out())]
    work = [ca.MX()] * function.sz_w()
    for k in range(function.n_instructions()):
        operation, read, write = (of(k) for of in (function.instruction_id, function.instruction_input,
                                                   function.instruction_output))  # fmt: skip
        if operation == ca.OP_INPUT:
            work[write[0]] = inputs[read[0]][read[1]]
        elif operation == ca.OP_OUTPUT:
            value = work[read[0]]
            outputs[write[0]][write[1]] = value if value.numel() == count else ca.repmat(value, count)
        elif operation == ca.OP_CONST:
            work[write[0]] = ca.MX(function.instruction_constant(k))
        elif len(read) == 1:
            work[write[0]] = ca.MX.unary(operation, work[read[0]])
        else:
            work[write[0]] = ca.MX.binary(operation, work[read[0]], work[read[1]])
    return ca.Function(function.name(), list(chain(*inputs)), list(chain(*outputs)))


def _without_zeros(function: ca.Function) -> ca.Function:
    """The same function, outputs without the entries that are always zero."""
    symbols = function.sx_in()
    return ca.Function(function.name(), symbols, [ca.sparsify(part) for part in function.call(symbols)])


def _is_scalar(function: ca.Function) -> bool:
    """True where a function is all scalar operations, and not too many to be replayed."""
    # Each instruction takes some ten microseconds to set up.
    if not function.is_a("SXFunction") or function.n_instructions() > 50_000:
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
