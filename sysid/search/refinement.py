"""Eigenvalue refinement of a swarm's candidates (eq. 31): in closed form, through IPOPT, or of its leaders by both."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from sysid.models.expressions import triangle
from sysid.models.spectrum import spectrum_error
from sysid.problem.prepared import Prepared
from sysid.search.session import Session
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF

RefineBy = Literal["closed-form", "ipopt", "leaders"]


@dataclass
class Tally:
    """Counts of the ends of IPOPT's refinements.

    Attributes
    ----------
    tried, won : int
        Leaders of the swarm that IPOPT refined, and those of them that it left at a lower objective than the closed
        form.
    statuses : Counter
        How often IPOPT ended with each status, whatever it refined.
    """

    tried: int = 0
    won: int = 0
    statuses: Counter[str] = field(default_factory=Counter)

    def add(self, other: Tally) -> None:
        """Add the counts of another swarm."""
        self.tried, self.won = self.tried + other.tried, self.won + other.won
        self.statuses.update(other.statuses)

    @property
    def of_history(self) -> dict[str, Any]:
        """The fields of `History`."""
        return {
            "leaders_tried": self.tried, "leaders_won": self.won,
            "refinement_statuses": tuple(sorted(self.statuses.items())),
        }  # fmt: skip

    def to_tree(self) -> dict[str, Any]:
        """Give the counts as numbers; `resume` takes them back."""
        return {"tried": self.tried, "won": self.won, "statuses": dict(self.statuses)}

    def resume(self, tree: dict[str, Any]) -> None:
        """Go on from the counts of an earlier run."""
        self.tried, self.won, self.statuses = tree["tried"], tree["won"], Counter(tree["statuses"])


class Refiner:
    """Gives candidates the measured spectrum.

    Parameters
    ----------
    problem : Prepared
    by : {"closed-form", "ipopt", "leaders"}
    spectrum : (m,), rad/s
    session : Session
        IPOPT keeps to the time that it has left.
    tally : Tally
        Takes the counts.
    """

    def __init__(self, problem: Prepared, by: RefineBy, spectrum: Array, session: Session, tally: Tally) -> None:
        self.problem, self.by, self.spectrum, self.session, self.tally = problem, by, spectrum, session, tally
        self._part, self._with_spectrum = problem.formulation.parts.stiffness, problem.formulation.with_spectrum

    def rows(self, rows: Array) -> Array:
        """Rows (k, n_variables), of the swarm or of unknowns alike, with refined entries of L_H; counted."""
        refined, statuses = self._refined(rows, by_solver=self.by == "ipopt")
        self.tally.statuses.update(statuses)
        return refined

    def one(self, x: Array) -> Array:
        """The unknowns of the structure that `x` was given its objective for."""
        return self._refined(x[None], by_solver=self.by == "ipopt")[0][0]

    def error(self, x: Array) -> float:
        """Largest relative difference of the unknowns' eigenvalues from those that were given."""
        return spectrum_error(triangle(x[self._part], self.problem.geometry.n), self.spectrum)

    def of_leader(self, objective: Callable[[Array], Array]) -> Callable[[Array, float], tuple[Array, float]]:
        """Function that refines a new leader, in the swarm's coordinates, for an objective of rows."""

        def refine(row: Array, cost: float) -> tuple[Array, float]:
            if self.session.is_over:
                return row, cost
            solved, statuses = self._refined(row[None], by_solver=True)
            self.tally.tried += 1
            self.tally.statuses.update(statuses)
            closed = self._refined(row[None], by_solver=False)[0]
            rows = np.clip(np.concatenate([closed, solved]), *self.problem.formulation.box)
            of_closed, of_solved = objective(rows)
            if of_solved < (1 - ROUND_OFF) * np.fmin(of_closed, cost):
                self.tally.won += 1
                return rows[1], float(of_solved)
            # The leader's objective is the closed form's already, unless a bound cut that off.
            return (rows[0], min(float(of_closed), cost)) if of_closed <= (1 + ROUND_OFF) * cost else (row, cost)

        return refine

    def _refined(self, rows: Array, *, by_solver: bool) -> tuple[Array, tuple[str, ...]]:
        """Rows with refined entries of L_H, and IPOPT's status of each."""
        refined, left = rows.copy(), None if self.session.max_time is None else self.session.left
        refined[:, self._part], statuses = self._with_spectrum(
            rows[:, self._part], self.spectrum, by_solver=by_solver, max_time=left
        )
        return refined, statuses
