"""Matrices of the three-storey building of Majcher (2025), and their extremes, from accelerations only."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import sysid
from benchmarks.line import Line, below
from benchmarks.modal.identification import error_text, identify_records
from benchmarks.problem_modules import load_module

BOUND = 1e-6
NEARLY = 3e-7  # share of the total on the modes that an extreme leaves without mass: it is reached in the limit only


def lines(reduced: bool) -> Iterator[Line]:
    """Lumped mass with and without its total; full mass with and without one. Both forms are the same."""
    module = load_module("shear_building")
    truth, masses, springs = module.building(), module.MASSES, module.SPRINGS
    test = sysid.simulate(truth, np.linspace(0.2, 6.0, 300))
    total = float(masses.sum())
    what = "three-storey building, accelerations only, no noise, "

    text = what + "lumped mass with its total: "
    result, said = _identify(test, sysid.LumpedMass(total))
    if result is None:
        yield Line(text + "m and k", said, f"within {BOUND:g}", False)
    else:
        m, k = _masses_and_springs(result.structure)
        off = max(np.max(np.abs(m / masses - 1)), np.max(np.abs(k / springs - 1)))
        yield below(text + f"largest relative error of m and k (m {m.round(6).tolist()} kg)", float(off), BOUND)
        yield _said(text + "determined", result, True)

    text = what + "lumped mass without a total: "
    result, said = _identify(test, sysid.LumpedMass())
    if result is None:
        yield Line(text + "ratios", said, f"within {BOUND:g}", False)
    else:
        m, k = _masses_and_springs(result.structure)
        ratios, true = (np.concatenate([a, b]) / a.sum() for a, b in ((m, k), (masses, springs)))
        error = float(np.max(np.abs(ratios / true - 1)))
        yield below(text + "largest relative error of m and k over the sum of m", error, BOUND)
        yield _said(text + "determined", result, False)

    for label, model in {
        "full mass with its total": sysid.FullMass(total),
        "full mass with its total as rigid-body mass": sysid.FullMass(total, healing="rigid_body"),
        "full mass without a total": sysid.FullMass(),
    }.items():
        text = what + label + ": "
        result, said = _identify(test, model)
        if result is None:
            yield Line(text + "intervals", said, f"within {BOUND:g}", False)
        else:
            yield _said(text + "determined", result, False)
            if model.total_mass is not None:
                yield _inside(text + "true entries of M_SS and K_SS outside their intervals", result, truth)
            yield from _ends(text, result, Cone.of(truth, model))


def _identify(test: sysid.Measurement, mass: object) -> tuple[sysid.Identification | None, str]:
    try:
        return identify_records(test, mass), ""
    except Exception as error:  # a crash is an answer too, and must not end the others
        return None, error_text(error)


def _masses_and_springs(structure: sysid.Structure) -> tuple[np.ndarray, np.ndarray]:
    """Floor masses, and spring constants from the ground up; an entry that a chain has not counts to both."""
    n = structure.n
    K = structure.stiffness[:n, :n]
    above = np.append(-np.diag(K, 1), 0.0)  # spring from each floor to the next
    corner = abs(K[0, -1]) + np.abs(np.triu(structure.mass[:n, :n], 1)).max()
    return np.diag(structure.mass)[:n] + corner, np.concatenate([[K[0, 0] - above[0]], above[:-1]]) + corner


def _said(text: str, result: sysid.Identification, expected: bool) -> Line:
    reasons = "; ".join(result.closed_by + result.undetermined)
    return Line(f"{text} ({reasons})", str(result.determined), str(expected), result.determined == expected)


def _inside(text: str, result: sysid.Identification, truth: sysid.Structure) -> Line:
    outside, n = 0, truth.n
    for interval, matrix in ((result.mass_interval, truth.mass), (result.stiffness_interval, truth.stiffness)):
        slack = 1e-9 * np.abs(matrix).max()
        true = matrix[:n, :n]
        outside += np.count_nonzero((true < interval[0] - slack) | (true > interval[1] + slack))
    return below(text, outside, 0)


@dataclass(frozen=True, eq=False)
class Cone:
    """All models with one base direction that answer as `truth` does: one modal mass t_k >= 0 a mode.

    Attributes
    ----------
    truth : sysid.Structure
        The member t = 1.
    P : (n, n)
        Inverse of its mode shapes.
    weights : (n,)
        What a unit of each modal mass adds to the stated total.
    total : float
        kg that the modes can carry at most; infinite where none is stated.
    """

    truth: sysid.Structure
    P: np.ndarray
    weights: np.ndarray
    total: float

    @classmethod
    def of(cls, truth: sysid.Structure, model: sysid.FullMass) -> Cone:
        """The cone of the truth's modes under what `model` states."""
        P = np.linalg.inv(truth.mode_shapes)
        delta = truth.participation - P @ truth.rigid_body
        trace = np.sum(P**2, axis=1) + delta[:, 0] ** 2
        weights = trace if model.healing == "trace" else truth.participation[:, 0] ** 2
        return cls(truth, P, weights, np.inf if model.total_mass is None else float(model.total_mass))

    def extremes(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper extremes of the matrix `name`, (n, n).

        There is one inequality, so either one mode carries all of the total or none carries any.
        """
        with np.errstate(invalid="ignore"):
            corners = self._coefficients(name) * (self.total / self.weights)[:, None, None]
        corners = np.where(self._coefficients(name) == 0, 0.0, corners)
        return np.minimum(corners.min(axis=0), 0.0), np.maximum(corners.max(axis=0), 0.0)

    def near(self, name: str, i: int, j: int, upper: bool) -> sysid.Structure:
        """A member, of positive modal masses, in which entry (i, j) of the matrix `name` all but is extreme."""
        n = self.truth.n
        worth = self._coefficients(name)[:, i, j] / self.weights * (1 if upper else -1)
        share = np.full(n, NEARLY / n)
        if worth.max() > 0:
            share[np.argmax(worth)] = 1 - NEARLY
        return self.member(share * self.total / self.weights)

    def member(self, t: np.ndarray) -> sysid.Structure:
        """The model with modal masses t (n,), and the least mass on the base that goes with them."""
        truth, P, G = self.truth, self.P, self.truth.rigid_body
        delta = truth.participation - P @ G
        M_SS, M_S0, M_00 = ((a.T * t) @ b for a, b in ((P, P), (P, delta), (delta, delta)))
        K_SS = (P.T * (t * (2 * np.pi * truth.natural_frequencies) ** 2)) @ P
        K = np.block([[K_SS, -K_SS @ G], [-(K_SS @ G).T, G.T @ K_SS @ G]])
        M = np.block([[M_SS, M_S0], [M_S0.T, M_00]])
        return sysid.Structure(M, (K + K.T) / 2, truth.damping_ratios, n_base=1)

    def _coefficients(self, name: str) -> np.ndarray:
        forms = np.einsum("ki,kj->kij", self.P, self.P)
        if name == "stiffness":
            forms = forms * ((2 * np.pi * self.truth.natural_frequencies) ** 2)[:, None, None]
        return forms


def _ends(text: str, result: sysid.Identification, cone: Cone) -> Iterator[Line]:
    """The stated ends against the closed form, and against members that reach them."""
    off, missed, residual, finite = 0.0, 0.0, 0.0, 0
    n = cone.truth.n
    for name, interval in (("mass", result.mass_interval), ("stiffness", result.stiffness_interval)):
        for end, expected in enumerate(cone.extremes(name)):
            stated = interval[end]
            for i in range(n):
                for j in range(i + 1):
                    pair = interval[:, i, j]
                    size = np.abs(pair[np.isfinite(pair)]).max(initial=0.0)
                    if not (np.isfinite(stated[i, j]) and np.isfinite(expected[i, j])):
                        off = max(off, 0.0 if stated[i, j] == expected[i, j] else np.inf)
                        continue
                    finite += 1
                    if size == 0:  # a finite end of zero beside an infinite one
                        off = max(off, abs(expected[i, j]))
                        continue
                    off = max(off, abs(stated[i, j] - expected[i, j]) / size)
                    member = cone.near(name, i, j, upper=end == 1)
                    missed = max(missed, abs(getattr(member, name)[i, j] - stated[i, j]) / size)
                    residual = max(residual, result.measurement.residual(member))
    what = f"ends of M_SS and K_SS ({finite} finite): largest relative distance from "
    yield below(text + what + "the closed form", float(off), BOUND)
    if np.isfinite(cone.total):
        yield below(text + what + f"a member of the cone (residual at most {residual:.1e})", float(missed), BOUND)
