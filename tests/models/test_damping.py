"""Damping models: physical damping in the modes, Rayleigh's closed form, round trips, refusals."""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid import InputError, ModalDamping, ProportionalDamping
from sysid.modal_analysis.vector_fitting import Poles
from sysid.models.model import MassBlocks, StiffnessBlocks
from sysid.models.stiffness_and_damping import WrittenDamping

SEEDS = range(5)


def numbers(expression):
    return np.asarray(ca.evalf(expression))


@pytest.mark.parametrize("seed", SEEDS)
def test_the_damping_of_ratios_is_eq_33(random_structure, seed):
    s = random_structure(np.random.default_rng(seed), n=5, d=2)
    inverse = np.linalg.inv(s.mode_shapes)
    expected = inverse.T @ np.diag(2 * s.damping_ratios * 2 * np.pi * s.natural_frequencies) @ inverse
    np.testing.assert_allclose(s.damping, expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("seed", SEEDS)
def test_rayleigh_ratios_are_those_of_alpha_M_plus_beta_K(random_structure, geometry_of, seed):
    rng = np.random.default_rng(seed)
    s = random_structure(rng, n=4, d=1)
    alpha, beta = rng.uniform(0.1, 2), rng.uniform(1e-5, 1e-3)
    n, omega = s.n, 2 * np.pi * s.natural_frequencies
    M, K = s.mass[:n, :n], s.stiffness[:n, :n]
    C = alpha * M + beta * K
    expected = np.diag(s.mode_shapes.T @ C @ s.mode_shapes) / (2 * omega)
    model, geometry, y = ProportionalDamping((0, 2), (0, 1e-3)), geometry_of(s.rigid_body), ca.DM([alpha, beta])
    ratios = numbers(model.ratios(geometry, y, ca.DM(omega))).ravel()
    np.testing.assert_allclose(ratios, expected, rtol=1e-9)
    np.testing.assert_allclose(ratios, alpha / (2 * omega) + beta * omega / 2, rtol=1e-12)
    L = ca.DM(np.linalg.cholesky(M))
    mass = MassBlocks(L, ca.DM.zeros(n, 1), ca.DM.zeros(1, 1), ca.DM(M))
    made = numbers(model.blocks(geometry, y, mass, StiffnessBlocks(ca.DM(K), None)))
    np.testing.assert_allclose(made, C, rtol=1e-12)
    damped = sysid.Structure(s.mass, s.stiffness, ratios, n_base=1)
    np.testing.assert_allclose(model.values(geometry, damped), [alpha, beta], rtol=1e-9)


def test_alpha_and_beta_of_other_ratios_are_those_of_least_squares(geometry_of):
    """Of two modes at 1 and 2 rad/s and a third at 4: alpha / 2w + beta w / 2 by the normal equations."""
    omega, ratios = np.array([1.0, 2.0, 4.0]), np.array([0.02, 0.01, 0.03])
    s = sysid.Structure(
        np.diag([1.0, 1, 1, 0]),
        np.block([[np.diag(omega**2), -(omega**2)[:, None]], [-(omega**2)[None], np.array([[omega @ omega]])]]),
        ratios, n_base=1,
    )  # fmt: skip
    # Columns (1/2, 1/4, 1/8) and (1/2, 1, 2): sums of squares 21/64 and 21/4, product 3/4.
    left = np.array([[21 / 64, 3 / 4], [3 / 4, 21 / 4]])
    right = np.array([0.02 / 2 + 0.01 / 4 + 0.03 / 8, 0.02 / 2 + 0.01 + 0.06])
    alpha_beta = ProportionalDamping((0, 1), (0, 1)).values(geometry_of(np.ones((3, 1))), s)
    np.testing.assert_allclose(alpha_beta, np.linalg.solve(left, right), rtol=1e-12)


def test_alpha_and_beta_stay_within_their_bounds(geometry_of):
    """Ratios that rise faster than in proportion to the frequency would need an alpha below zero: beta is left alone.

    ``beta = c . zeta / c . c`` with c = w / 2 = (1/2, 1, 2).
    """
    omega, ratios = np.array([1.0, 2.0, 4.0]), np.array([0.001, 0.02, 0.05])
    K = np.diag(omega**2)
    base = K.sum(axis=1)
    full = np.block([[K, -base[:, None]], [-base[None], np.array([[base.sum()]])]])
    s = sysid.Structure(np.diag([1.0, 1, 1, 0]), full, ratios, n_base=1)
    alpha, beta = ProportionalDamping((0, 1), (0, 1)).values(geometry_of(np.ones((3, 1))), s)
    assert alpha == pytest.approx(0.0, abs=1e-12)
    assert beta == pytest.approx((0.001 / 2 + 0.02 + 0.05 * 2) / (1 / 4 + 1 + 4), rel=1e-9)


def test_modal_ratios_are_the_unknowns_and_there_is_no_matrix(geometry_of):
    y, geometry, model = np.array([0.01, 0.02, 0.03, 0.04]), geometry_of(np.ones((4, 1))), ModalDamping()
    np.testing.assert_array_equal(numbers(model.ratios(geometry, ca.DM(y), ca.DM([1, 2, 3, 4]))).ravel(), y)
    assert model.blocks(geometry, ca.DM(y), None, None) is None
    s = sysid.Structure(np.eye(5), np.block([[np.eye(4), -np.ones((4, 1))], [-np.ones((1, 4)), 4]]), y, n_base=1)
    np.testing.assert_array_equal(model.values(geometry, s), y)


def with_poles(geometry_of, ratios, n=4):
    geometry = geometry_of(np.ones((n, 1)))
    geometry.poles = Poles(1.0 + np.arange(len(ratios)), np.array(ratios), 0.01)
    return geometry


def test_search_spaces(geometry_of):
    geometry = with_poles(geometry_of, [0.005, 0.01, 0.02, 0.05])
    (unknown,) = ModalDamping().unknowns(geometry)
    np.testing.assert_array_equal(unknown.box, [[0.005] * 4, [0.05] * 4])  # eq. 38
    assert unknown.note == ""
    np.testing.assert_array_equal([unknown.lower, unknown.upper], [[1e-6] * 4, [0.95] * 4])
    np.testing.assert_allclose(unknown.guess, 0.0275)
    alpha, beta = ProportionalDamping((0.1, 2), (1e-5, 1e-3)).unknowns(geometry)
    assert [(v.lower.item(), v.upper.item(), v.unit) for v in (alpha, beta)] == [(0.1, 2, "1/s"), (1e-5, 1e-3, "s")]


def test_the_box_follows_poles_outside_the_usual_one_by_half_a_decade_either_way(geometry_of):
    (unknown,) = ModalDamping().unknowns(with_poles(geometry_of, [0.001, 0.02, 0.2, 0.4]))
    root = 10**0.5
    np.testing.assert_allclose(unknown.box[0], [0.001 / root, 0.005, 0.2 / root, 0.4 / root])
    np.testing.assert_allclose(unknown.box[1], [0.001 * root, 0.05, 0.2 * root, 0.95])
    assert "0.1 to 40 %" in unknown.note


def test_where_poles_and_modes_are_not_as_many_all_modes_have_the_box_of_all_poles(geometry_of):
    (unknown,) = ModalDamping().unknowns(with_poles(geometry_of, [0.001, 0.1]))
    np.testing.assert_allclose(unknown.box, [[0.001 / 10**0.5] * 4, [0.1 * 10**0.5] * 4])
    (unknown,) = ModalDamping().unknowns(with_poles(geometry_of, []))
    np.testing.assert_array_equal(unknown.box, [[0.005] * 4, [0.05] * 4])


def test_stated_bounds_are_bounds_and_box_whatever_the_poles(geometry_of):
    geometry = with_poles(geometry_of, [0.001, 0.02, 0.2, 0.4])
    (unknown,) = ModalDamping(0.002, 0.08).unknowns(geometry)
    for ends in ((unknown.lower, unknown.upper), unknown.box):
        np.testing.assert_array_equal(ends, [[0.002] * 4, [0.08] * 4])


@pytest.mark.parametrize("bounds", [(0.1, 0.95), (0.9, 0.95), (1e-6, 0.002), (1e-6, 5e-6)])
def test_a_single_bound_is_an_end_of_a_box_within_the_bounds(geometry_of, bounds):
    """An unknown refuses a box that leaves its bounds."""
    (unknown,) = ModalDamping(*bounds).unknowns(with_poles(geometry_of, [0.01] * 4))
    stated = 0 if bounds[1] == 0.95 else 1
    np.testing.assert_array_equal(unknown.box[stated], [bounds[stated]] * 4)
    assert np.all(unknown.box[0] < unknown.box[1])


def test_the_note_tells_the_box_that_a_stated_bound_leaves(geometry_of):
    """Poles from 10 to 40 % would have a box up to 95 %."""
    (unknown,) = ModalDamping(upper=0.3).unknowns(with_poles(geometry_of, [0.1, 0.1, 0.2, 0.4]))
    assert "searched from 3.16 to 30 %" in unknown.note


def test_what_is_stated(geometry_of):
    geometry = geometry_of(np.ones((4, 1)))
    for model, free in ((ModalDamping(), True), (ProportionalDamping((0, 1), (0, 1)), False)):
        stated = model.stated(geometry)
        assert stated.free is free
        assert (stated.entries, stated.totals, stated.spectrum, stated.positive) == (None, None, None, None)
    assert not WrittenDamping(np.eye(4)).stated(geometry).free


@pytest.mark.parametrize("bounds", [(0.0, 0.1), (-0.1, 0.1), (0.1, 0.1), (0.2, 0.1), (0.1, 1.0)])
def test_modal_bounds_that_are_none(bounds):
    with pytest.raises(InputError, match="ModalDamping: 0 < lower < upper < 1"):
        ModalDamping(*bounds)


@pytest.mark.parametrize("bad", [(-1.0, 1.0), (1.0, 1.0), (2.0, 1.0), (0.0, np.inf), (np.nan, 1.0)])
def test_proportional_bounds_that_are_none(bad):
    with pytest.raises(InputError, match="alpha (needs|holds)"):
        ProportionalDamping(bad, (0, 1))
    with pytest.raises(InputError, match="beta (needs|holds)"):
        ProportionalDamping((0, 1), bad)


class TestWritten:
    """C in numbers or variables over the degrees of freedom, base rows cut off; or one ratio a mode."""

    def test_numbers_have_no_unknowns_and_variables_no_inverse(self, geometry_of, random_structure):
        geometry = geometry_of(np.ones((3, 1)))
        s = random_structure(np.random.default_rng(0), n=3, d=1)
        held = sysid.Variable("held", lower=0, upper=1, guess=0.5, fixed=True)
        for given in (np.eye(3), [0.01, 0.02, 0.03], held * ca.DM.eye(3)):
            assert WrittenDamping(given).values(geometry, s).shape == (0,)
            assert WrittenDamping(given).unknowns(geometry) == ()
        c = sysid.Variable("c", 3, lower=0, upper=1)
        with pytest.raises(InputError, match="damping written in expressions has no inverse"):
            WrittenDamping(ca.diag(c)).values(geometry, s)

    def test_base_rows_are_cut_off(self, geometry_of):
        C = np.array([[3.0, -1, -2], [-1, 1, 0], [-2, 0, 2]])
        model, geometry = WrittenDamping(C), geometry_of(np.ones((2, 1)))
        made = ca.DM(ca.evalf(model.blocks(geometry, ca.MX(0, 1), None, None)))
        np.testing.assert_array_equal(np.asarray(ca.densify(made)), C[:2, :2])
        assert model.ratios(geometry, ca.MX(0, 1), ca.MX.sym("w", 2)) is None

    @pytest.mark.parametrize("n", [1, 3])
    def test_a_column_is_ratios_of_one_mode_each(self, geometry_of, n):
        given, geometry = np.linspace(0.01, 0.03, n), geometry_of(np.ones((n, 1)))
        model = WrittenDamping(given)
        assert model.blocks(geometry, ca.MX(0, 1), None, None) is None
        made = numbers(model.ratios(geometry, ca.MX(0, 1), ca.MX.sym("w", n)))
        np.testing.assert_array_equal(made.ravel(), given)

    def test_of_one_degree_of_freedom_a_matrix_is_no_ratio(self, geometry_of):
        model, geometry = WrittenDamping([[0.3]]), geometry_of(np.ones((1, 1)))
        assert numbers(model.blocks(geometry, ca.MX(0, 1), None, None)).item() == 0.3
        assert model.ratios(geometry, ca.MX(0, 1), ca.MX.sym("w", 1)) is None
