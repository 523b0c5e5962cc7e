"""Complex expressions in variables, as a pair of CasADi's real ones, with the operators of arithmetic."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from sysid.errors import InputError


class ComplexExpression(NamedTuple):
    """A complex expression: real and imaginary part, of one shape.

    Sums, products and quotients are entry by entry; a row and a column beside a matrix, or a single number, stand for
    all its rows and columns. ``@`` is the product of matrices, `numpy.exp` and `numpy.conj` take it.
    """

    real: ca.MX
    imag: ca.MX

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> ComplexExpression:
        return by_numpy(ufunc, inputs)

    def __add__(self, other: Any) -> ComplexExpression:
        a, b = _alike(self, other)
        return ComplexExpression(a.real + b.real, a.imag + b.imag)

    def __sub__(self, other: Any) -> ComplexExpression:
        return self + -as_complex(other)

    def __mul__(self, other: Any) -> ComplexExpression:
        a, b = _alike(self, other)
        return ComplexExpression(a.real * b.real - a.imag * b.imag, a.real * b.imag + a.imag * b.real)

    def __truediv__(self, other: Any) -> ComplexExpression:
        a, b = _alike(self, other)
        over = a * b.conj()
        size = b.real**2 + b.imag**2
        return ComplexExpression(over.real / size, over.imag / size)

    def __matmul__(self, other: Any) -> ComplexExpression:
        a, b = self, as_complex(other)
        if a.real.shape[1] != b.real.shape[0]:
            raise InputError(f"matrices of {a.real.shape} and {b.real.shape} have no product")
        return ComplexExpression(a.real @ b.real - a.imag @ b.imag, a.real @ b.imag + a.imag @ b.real)

    def __neg__(self) -> ComplexExpression:
        return ComplexExpression(-self.real, -self.imag)

    def __radd__(self, other: Any) -> ComplexExpression:
        return as_complex(other) + self

    def __rsub__(self, other: Any) -> ComplexExpression:
        return as_complex(other) - self

    def __rmul__(self, other: Any) -> ComplexExpression:
        return as_complex(other) * self

    def __rtruediv__(self, other: Any) -> ComplexExpression:
        return as_complex(other) / self

    def __rmatmul__(self, other: Any) -> ComplexExpression:
        return as_complex(other) @ self

    def conj(self) -> ComplexExpression:
        """The complex conjugate."""
        return ComplexExpression(self.real, -self.imag)

    def exp(self) -> ComplexExpression:
        """``exp`` of each entry."""
        size = ca.exp(self.real)
        return ComplexExpression(size * ca.cos(self.imag), size * ca.sin(self.imag))


_OF_NUMPY: dict[Any, Callable[..., ComplexExpression]] = {
    np.add: operator.add, np.subtract: operator.sub, np.multiply: operator.mul, np.true_divide: operator.truediv,
    np.matmul: operator.matmul, np.negative: operator.neg, np.conjugate: ComplexExpression.conj,
    np.exp: ComplexExpression.exp,
}  # fmt: skip


def by_numpy(ufunc: Any, inputs: tuple[Any, ...]) -> ComplexExpression:
    """A function of NumPy's of operands of which one is complex and one an expression."""
    if ufunc not in _OF_NUMPY:
        raise InputError(f"numpy.{ufunc.__name__} takes no complex expression: + - * / @, numpy.exp, numpy.conj do")
    return _OF_NUMPY[ufunc](*map(as_complex, inputs))


def is_complex(value: Any) -> bool:
    """True of complex numbers, arrays of them, and complex expressions."""
    if isinstance(value, np.ndarray | np.generic):
        return value.dtype.kind == "c"
    return isinstance(value, complex | ComplexExpression)


def as_complex(value: Any) -> ComplexExpression:
    """Numbers, an array (of one dimension: a column) or an expression as a complex expression."""
    if isinstance(value, ComplexExpression):
        return value
    if is_complex(value):
        return ComplexExpression(ca.MX(ca.DM(np.real(value))), ca.MX(ca.DM(np.imag(value))))
    real = ca.MX(ca.DM(value) if isinstance(value, np.ndarray) else value)
    return ComplexExpression(real, ca.MX(*real.shape))


def _alike(one: Any, other: Any) -> tuple[ComplexExpression, ComplexExpression]:
    """Both in one shape: rows and columns are repeated where the other has more."""
    pair = as_complex(one), as_complex(other)
    shapes = [part.real.shape for part in pair]
    wanted = [max(sizes) for sizes in zip(*shapes, strict=True)]
    if any(size not in (1, most) for shape in shapes for size, most in zip(shape, wanted, strict=True)):
        words = "sensors are rows and lines are columns, such as 2j * np.pi * test.freq[None]"
        raise InputError(f"complex expressions of {shapes[0]} and {shapes[1]} do not fit: {words}")
    a, b = (
        ComplexExpression(*(ca.repmat(one, wanted[0] // shape[0], wanted[1] // shape[1]) for one in part))
        for part, shape in zip(pair, shapes, strict=True)
    )
    return a, b
