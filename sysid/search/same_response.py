r"""Distance of the responses of many candidates from those of an answer, at complex frequencies.

Away from the imaginary axis, at :math:`s = \sigma + i\omega`, no peak is narrow, so that a descent comes from far away;
and two structures whose responses agree there at more lines than they have coefficients agree everywhere, to the
records' own lines.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from sysid.modal_analysis.complex_frequency import BEYOND
from sysid.modal_analysis.response import columns
from sysid.problem.batch import Batch, expanded, in_chunks
from sysid.problem.prepared import Prepared
from sysid.problem.terms import ExpressionTerm, TestTerm
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import NEGLIGIBLE

SHIFT = 0.3  # of the geometric mean of the natural frequencies
LINES = 4  # a degree of freedom: twice as many numbers as a response has coefficients


class SameResponse:
    """Differences of all that is fitted from what it is at an answer, (count, size) to (count, rows).

    Responses relative to their size, further rows (what is stated as known, say) and broken constraints as the fit
    weighs them.

    Parameters
    ----------
    problem : Prepared
    x : (size,)
        The answer.
    """

    def __init__(self, problem: Prepared, x: Array) -> None:
        formulation = problem.formulation
        self.terms = [_Response(term, x) for term in formulation.tests]
        further = [term for term in formulation.beside if isinstance(term, ExpressionTerm)]
        symbol = ca.MX.sym("x", x.size)
        rows = [ca.densify(term.rows(symbol)) for term in further]
        constraints = formulation.constraints
        if constraints.lower.size:
            g, unit = constraints.function(symbol), ca.DM(problem.tolerance)
            beyond = ca.fmax(ca.fmax(ca.DM(constraints.lower) - g, g - ca.DM(constraints.upper)), 0)
            rows.append(ca.densify(beyond / unit))
        self.further = Batch(expanded(ca.Function("rows", [symbol], [ca.vertcat(*rows)]))) if rows else None
        self.at_answer = self._values(x[None])

    def __call__(self, points: Array) -> Array:
        """The differences; not finite where a candidate is no structure."""
        return in_chunks(lambda chunk: self._values(chunk) - self.at_answer, points)

    def _values(self, points: Array) -> Array:
        parts = [term(points) for term in self.terms]
        if self.further is not None:
            parts.append(self.further(points)[0][:, :, 0])
        return np.hstack(parts)


class _Response:
    """Response of candidates in a test at complex frequencies, over its size at an answer, (count, rows)."""

    def __init__(self, term: TestTerm, x: Array) -> None:
        matrices = self.matrices = term.matrices
        structure = matrices.structure(x, term.test)
        omega = 2 * np.pi * structure.natural_frequencies
        lines = np.linspace(0.0, (1 + BEYOND) * omega[-1], LINES * omega.size + 1)[1:]
        self.s = SHIFT * float(np.exp(np.log(omega).mean())) + 1j * lines
        base = columns(term.test.base)
        directions, size, _ = np.linalg.svd(np.hstack([base.real, base.imag]), full_matrices=False)
        self.inputs = directions[:, size > NEGLIGIBLE * size[0]]
        self.with_force = term.test.force is not None
        symbol, n = ca.MX.sym("x", x.size), structure.n
        self._expand = Batch(
            expanded(ca.Function("matrices", [symbol], [ca.densify(part) for part in matrices.function(symbol)]))
        )
        w = ca.MX.sym("w", n)
        self._ratios = None
        if matrices.by_ratios:
            self._ratios = Batch(expanded(ca.Function("ratios", [symbol, w], [matrices.ratio_function(symbol, w)])))
        self.scales = [np.ones((1, 1, 1, 1))] * (1 + self.with_force)
        records = self._records(x[None])
        self.scales = [np.linalg.norm(record, axis=(1, 3), keepdims=True) for record in records]
        self.weight = term.weight

    def __call__(self, points: Array) -> Array:
        records = np.concatenate([record.reshape(len(points), -1) for record in self._records(points)], axis=1)
        return self.weight * np.hstack([records.real, records.imag])

    def _records(self, points: Array) -> list[ComplexArray]:
        """Accelerations and, where measured, force for each input, (count, lines, channels, inputs) each."""
        M, M_S0, M_00, K, C, L, H = self._expand(points)
        G, s = self.matrices.rigid_body, self.s[:, None, None]
        if self._ratios is not None:
            C, broken = self._damping(points, L, H)
        else:
            broken = ~np.all([np.all(np.isfinite(part), axis=(1, 2)) for part in (M, M_S0, K, C)], axis=0)
        M[broken], K[broken], C[broken] = np.eye(len(G)), np.eye(len(G)), 0.0
        push = M @ G + M_S0
        Z = s**2 * M[:, None] + s * C[:, None] + K[:, None]
        right = -(s**2) * (push @ self.inputs)[:, None]
        a: ComplexArray = np.linalg.solve(Z, right)
        a[broken] = np.nan
        records: list[ComplexArray] = [self.matrices.recovery @ a]
        if self.with_force:
            rigid = G.T @ push + M_S0.swapaxes(1, 2) @ G + M_00
            records.append(push.swapaxes(1, 2)[:, None] @ a + (rigid @ self.inputs)[:, None])
        return [np.asarray(record / scale) for record, scale in zip(records, self.scales, strict=True)]

    def _damping(self, points: Array, L: Array, H: Array) -> tuple[Array, Array]:
        """``C = L Psi diag(2 zeta w) Psi' L'`` with ``H = Psi diag(w²) Psi'``, and which are no structure."""
        assert self._ratios is not None
        L = np.tril(L)
        broken = ~(np.all(np.isfinite(H), axis=(1, 2)) & np.all(np.isfinite(L), axis=(1, 2)))
        H[broken] = np.eye(H.shape[1])
        lam, psi = np.linalg.eigh((H + H.swapaxes(1, 2)) / 2)
        broken |= lam[:, 0] <= 0
        omega = np.sqrt(np.maximum(lam, np.finfo(float).tiny))
        ratios = self._ratios(points, omega)[0][:, :, 0]
        root = L @ psi
        return (root * (2 * ratios * omega)[:, None]) @ root.swapaxes(1, 2), broken
