"""Stated masses adjusted together with the records, against a direct fit of the matrices by SciPy."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares

from sysid import FullMass, InputError, Measurement, Problem, ProportionalDamping, Structure, identify, simulate

M_SS, M_S0, M_00 = np.array([[40.0, 3.0], [3.0, 25.0]]), np.array([5.0, 2.0]), 12.0
K_SS, RATIOS = np.array([[9e4, -4e4], [-4e4, 4e4]]), np.array([0.02, 0.015])
FREQ = np.linspace(2.0, 11.0, 120)
NAN = np.nan


def structure(M: np.ndarray, push: np.ndarray, base: float, K: np.ndarray, ratios: np.ndarray) -> Structure:
    one = np.ones((2, 1))
    mass = np.block([[M, push[:, None]], [push[None], np.array([[base]])]])
    return Structure(mass, np.block([[K, -K @ one], [-(K @ one).T, one.T @ K @ one]]), ratios, n_base=1)


TRUTH = structure(M_SS, M_S0, M_00, K_SS, RATIOS)


class Direct:
    """The same estimate by SciPy over the entries of the matrices, statements as further rows of the residual."""

    def __init__(
        self, test: Measurement, known: np.ndarray, std: np.ndarray, total: tuple[float, float] | None
    ) -> None:
        self.test, self.known, self.std, self.total = test, known, np.maximum(std, 1e-6), total
        self.size = np.concatenate([[40.0, 3.0, 25.0, 5.0, 2.0, 12.0], [9e4, 4e4, 4e4], RATIOS])
        start = np.concatenate([[40.0, 3.0, 25.0, 5.0, 2.0, 12.0], [9e4, -4e4, 4e4], RATIOS]) / self.size
        self.free = np.array([i != 5 or test.force is not None for i in range(start.size)])
        self.start = start
        answer = least_squares(self.rows, start[self.free], x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
        at = np.diag(self.size[self.free])
        self.structure = self.made(answer.x)
        self.covariance = at @ np.linalg.inv(answer.jac.T @ answer.jac) @ at

    def made(self, z: np.ndarray) -> Structure:
        whole = self.start.copy()
        whole[self.free] = z
        p = whole * self.size
        M, K = np.array([[p[0], p[1]], [p[1], p[2]]]), np.array([[p[6], p[7]], [p[7], p[8]]])
        return structure(M, p[3:5], p[5], K, p[9:])

    def rows(self, z: np.ndarray) -> np.ndarray:
        s, test = self.made(z), self.test
        left = [(test.predict(s) - test.relative) / test.response_std]
        if test.force is not None:
            left.append((test.predict_force(s) - test.force) / test.force_std)
        noise = np.concatenate([part.ravel() for part in left]) * np.sqrt(2)  # half of the variance in each real part
        told = np.isfinite(self.known) & np.triu(np.ones((2, 2), bool))
        stated = ((s.mass[:2, :2] - self.known) / self.std)[told]
        if self.total is not None:
            stated = np.append(stated, (s.rigid_body_mass[0, 0] - self.total[0]) / self.total[1])
        return np.concatenate([noise.real, noise.imag, stated])


@pytest.mark.parametrize(
    ("known", "std", "total"),
    [
        ([[40.0, 3.0], [3.0, 25.0]], 0.0, None),
        ([[40.2, 3.1], [3.1, 24.9]], 0.1, None),
        ([[40.0, NAN], [NAN, 24.9]], [[0.0, NAN], [NAN, 0.05]], None),
        ([[40.2, NAN], [NAN, NAN]], 0.1, (97.1, 0.1)),
        ([[NAN, NAN], [NAN, NAN]], 0.0, (97.2, 0.2)),
    ],
)
def test_estimate_and_deviations_are_those_of_a_direct_fit(known, std, total):
    test = simulate(TRUTH, FREQ, noise=0.01, rng=2, force=total is not None)
    stated = {"known": known, "known_std": std} if np.any(np.isfinite(known)) else {}
    if total is not None:
        stated |= {"total_mass": total[0], "total_std": total[1], "healing": "rigid_body"}
    result = identify(Problem(test, mass=FullMass(**stated)), strategy="modal")
    assert result.determined, result.undetermined
    direct = Direct(test, np.array(known), np.nan_to_num(np.broadcast_to(std, (2, 2))), total)
    variances = np.diag(direct.covariance)
    if test.force is None:
        variances = np.insert(variances, 5, 0.0)
    at = [(0, 0), (0, 1), (1, 1)]
    for name, wanted in (("mass", variances[:3]), ("stiffness", variances[6:9])):
        found = getattr(result.uncertainty, name) / result.uncertainty.inflation
        for (i, j), variance in zip(at, wanted, strict=True):
            own, other = (getattr(s, name)[i, j] for s in (result.structure, direct.structure))
            assert abs(own - other) < 0.05 * np.sqrt(variance) + 1e-5 * abs(other)
            np.testing.assert_allclose(found[i, j], np.sqrt(variance), rtol=0.05, atol=1e-5 * abs(other))


def test_a_wrong_entry_is_named_with_its_factor():
    test = simulate(TRUTH, FREQ, noise=0.01, rng=3, force=True)
    right = identify(Problem(test, mass=FullMass(known=M_SS, known_std=0.2)), strategy="modal")
    assert right.determined, right.undetermined
    wrong = M_SS + np.diag([0.0, 10.0])
    result = identify(Problem(test, mass=FullMass(known=wrong, known_std=0.2)), strategy="modal")
    assert not result.determined
    (told,) = result.of_kind("stated masses")
    assert (told.numbers["stated"], told.numbers["statements"]) == (35.0, 1)
    assert told.numbers["by the records"] == pytest.approx(25, rel=0.01)
    assert "row sensor 2" in told.sentence


def test_masses_in_another_unit_are_told_with_their_common_factor():
    test = simulate(TRUTH, FREQ, noise=0.01, rng=3, force=True)
    pounds = M_SS / 0.45359237
    result = identify(Problem(test, mass=FullMass(known=pounds, known_std=0.2)), strategy="modal")
    (told,) = result.of_kind("stated masses")
    assert told.numbers["factor"] == pytest.approx(0.45359237, rel=0.01)


def test_a_wrong_total_is_told_against_the_force():
    test = simulate(TRUTH, FREQ, noise=0.01, rng=3, force=True)
    total = TRUTH.rigid_body_mass[0, 0]
    result = identify(Problem(test, mass=FullMass(total + 10.0, healing="rigid_body", total_std=0.5)), strategy="modal")
    (told,) = result.of_kind("stated masses")
    assert (told.numbers["stated"], told.numbers["by the records"]) == pytest.approx((total + 10, total), rel=0.01)


@pytest.fixture
def gains_as_stated(monkeypatch):
    """No error of a gain among what is not known, which chance adds to one of two fits."""
    shown = lambda modal, structure: SimpleNamespace(possible=np.zeros(modal.records.n_sensors))  # noqa: E731
    monkeypatch.setattr("sysid.assessment.uncertainty.gain_errors", shown)


@pytest.mark.usefixtures("gains_as_stated")
def test_the_trace_is_a_statement_too():
    test = simulate(TRUTH, FREQ, noise=0.01, rng=3, force=True)
    total = np.trace(TRUTH.mass)
    result = identify(Problem(test, mass=FullMass(total, total_std=1e-6 * total)), strategy="modal")
    assert result.determined, result.undetermined
    assert np.trace(result.structure.mass) == pytest.approx(total, rel=1e-5)
    # Beside an exact total, with which the fit holds it.
    held = identify(Problem(test, mass=FullMass(total)), strategy="modal")
    np.testing.assert_allclose(result.uncertainty.mass, held.uncertainty.mass, rtol=0.02)


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({"known_std": 1.0}, "known_std is given without known"),
        ({"total_std": 1.0}, "total_std is given without total_mass"),
        ({"known": M_SS, "known_std": -1.0}, "deviations of 0 or above"),
        ({"known": M_SS, "known_std": [[1.0, NAN], [1.0, 1.0]]}, "deviations of 0 or above"),
        ({"known": M_SS, "known_std": [1.0, 1.0]}, "the shape of known, is needed"),
        ({"total_mass": 5.0, "total_std": np.inf}, "deviations of 0 or above"),
    ],
)
def test_wrong_deviations_are_refused(stated, words):
    with pytest.raises(InputError, match=words):
        FullMass(**stated)


def test_known_entries_beside_a_damping_that_cannot_use_them_are_refused_at_once():
    test = simulate(TRUTH, FREQ)
    with pytest.raises(InputError, match="ModalDamping alone"):
        Problem(test, mass=FullMass(known=M_SS), damping=ProportionalDamping((0.0, 1.0), (0.0, 1e-3)))
