"""The objective of a whole swarm at once, on compiled CasADi functions."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from sysid.problem.batch import Batch, expanded
from sysid.problem.prepared import Prepared
from sysid.problem.terms import TestTerm
from sysid.search.held_spectrum_objective import held_spectrum_objective
from sysid.search.matrix_coordinates import terms_with
from sysid.structure.structure import Array

WORST = 1e6  # an objective that no candidate passes that keeps the constraints


class SwarmObjective:
    """Objective of a swarm: (n_particles, n_variables) → (n_particles,), the problem's objective.

    Constraints count by the feasibility rules of Deb (Comput. Methods Appl. Mech. Eng. 186 (2000) 311-338): whatever
    keeps them comes before what does not.

    Parameters
    ----------
    problem : Prepared
        Its healing is applied.
    smoothed : sequence of TestTerm
        In the place of the problem's tests, in their order.
    spectrum : ndarray, optional
        Circular frequencies, rad/s, that take the place of each candidate's own lowest ones (eigenvalue refinement in
        closed form).
    """

    def __init__(self, problem: Prepared, smoothed: Sequence[TestTerm] = (), spectrum: Array | None = None) -> None:
        self.problem, self.spectrum = problem, spectrum
        self.terms = terms_with(problem.formulation, smoothed)
        formulation = problem.formulation
        s = ca.MX.sym("s", formulation.size)
        x = formulation.from_sampling(s)
        if formulation.healed:
            x = ca.fmin(ca.fmax(formulation.healing(x), ca.DM(formulation.lower)), ca.DM(formulation.upper))
        self._unknowns = expanded(ca.Function("unknowns", [s], [ca.densify(x)]))
        self._all_unknowns = Batch(self._unknowns)
        self._held = held_spectrum_objective(problem, self.terms[0], spectrum, self._unknowns)

    def __call__(self, particles: Array) -> Array:
        """Objective of each row; NaN where a candidate is no structure."""
        constraints = self.problem.formulation.constraints
        if self._held is not None and len(self.terms) == 1 and not constraints.lower.size:
            return np.sqrt(self._held(particles, self._by_lines))
        x = self._x(particles)
        squared = self._by_lines(particles) if self._held is None else self._held(particles, self._by_lines)
        objective = np.sqrt(sum((term.squared(x) for term in self.terms[1:]), squared))
        if not constraints.lower.size:
            return objective
        over = np.array([constraints.violation(row) for row in x]) / self.problem.tolerance
        over = np.where(np.isfinite(over), over, np.inf)
        broken = np.sum(np.where(over > 1, over, 0.0), axis=1)
        return np.where(broken > 0, WORST * (1 + broken), np.minimum(objective, WORST))

    def _x(self, particles: Array) -> Array:
        """Unknowns of each row, (n_particles, n_variables)."""
        return self._all_unknowns(particles)[0][:, :, 0]

    def _by_lines(self, particles: Array) -> Array:
        """The first term's part of the squared objective, summed over all lines, (n_particles,)."""
        first, x = self.terms[0], self._x(particles)
        return first.squared(x, self.spectrum) if isinstance(first, TestTerm) else first.squared(x)

    def unknowns(self, s: Array) -> Array:
        """The unknowns x that the swarm coordinates `s` stand for, healed."""
        return np.asarray(self._unknowns(s)).ravel()

    def refined(self, x: Array) -> Array:
        """The unknowns of the structure whose objective `x` was given: its spectrum replaced by the measured one."""
        if self.spectrum is None:
            return x
        formulation, refined = self.problem.formulation, x.copy()
        part = formulation.parts.stiffness
        refined[part] = formulation.with_spectrum(x[None, part], self.spectrum)[0][0]
        return refined
