"""A sensor's gain that is wrong is told with its size, and counts among what is not known; right ones are not told."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import scipy

import sysid
from sysid import FullMass, LumpedMass, Measurement, Problem, Structure, simulate
from sysid.assessment.assumptions import assumptions
from sysid.assessment.checks.gains import distinct_poles, gain_errors
from sysid.assessment.checks.stated import force_misfit
from sysid.modal_analysis.calibration import Calibration
from sysid.modal_analysis.modal_estimate import ModalEstimate

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
ERROR = 0.02


def lines(truth, count=300):
    f = truth.natural_frequencies
    return np.geomspace(0.5 * f[0], 1.3 * f[-1], count)


def misread(test, sensor, error=ERROR):
    """The same test with the record of one sensor read too large."""
    response = test.response.copy()
    response[:, sensor] *= 1 + error
    return dataclasses.replace(test, response=response)


def storeys(matrix=False):
    """Three storeys on a base without mass, 1 to 2 % damping, as ratios or as a matrix that is not modal."""
    K = 5000.0 * np.array([[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 1, 0], [-1, 0, 0, 1]])
    M = np.diag([4.0, 3.0, 5.0, 0.0])
    if not matrix:
        return Structure(M, K, [0.01, 0.015, 0.02], n_base=1)
    return Structure(M, K, n_base=1, damping_matrix=1e-3 * K[:3, :3] + np.diag([0.0, 0.0, 3.0]))


def shaken(structure, rng, runs=3):
    """Noise-free runs of random base motion in all directions at once."""
    freq = lines(structure)
    base = rng.normal(size=(2, runs, structure.n_base, freq.size))
    base = base[0] + 1j * base[1]
    response = np.einsum("sdf,rdf->rsf", structure.transmissibility(freq), base)
    return Measurement(freq, base, response, rigid_body=structure.rigid_body)


class TestEstimate:
    @pytest.mark.parametrize("unit", [True, False])
    @pytest.mark.parametrize("sensor", range(4))
    def test_is_the_error_that_was_made(self, random_structure, sensor, unit):
        rng = np.random.default_rng(sensor)
        truth = random_structure(rng, n=4, d=2)
        test = simulate(truth, lines(truth)) if unit else shaken(truth, rng)
        expected = np.where(np.arange(4) == sensor, ERROR, 0.0)
        found = gain_errors(ModalEstimate.of_lines(misread(test, sensor)), truth)
        np.testing.assert_allclose(found.error, expected, atol=1e-9)
        assert found.wrong.tolist() == [sensor]

    @pytest.mark.parametrize("dampers", [(40.0, 60.0, 0.0), (0.0, 900.0, 0.0), (2000.0, 900.0, 700.0)])
    def test_is_none_of_right_sensors_under_dampers_of_any_size(self, dampers):
        """Of local dampers, up to ones that let modes creep back: poles are far from those of undamped modes."""
        plain = storeys(matrix=True)
        truth = Structure(plain.mass, plain.stiffness, n_base=1, damping_matrix=plain.damping + np.diag(dampers))
        omega, ratios = distinct_poles(truth)
        roots = np.concatenate([np.roots([1.0, 2 * z * w, w**2]) for w, z in zip(omega, ratios, strict=True)])
        expected = scipy.linalg.eigvals(truth.to_state_space().A)
        np.testing.assert_allclose(np.sort_complex(roots), np.sort_complex(expected), rtol=1e-6)
        found = gain_errors(ModalEstimate.of_lines(simulate(truth, lines(truth))), truth)
        np.testing.assert_allclose(found.error, 0.0, atol=1e-9)
        assert not np.any(found.possible)

    def test_leaves_a_force_of_wrong_gain_told_under_local_dampers(self):
        plain = storeys(matrix=True)
        damping = plain.damping + np.diag([2000.0, 900.0, 700.0])
        truth = Structure(plain.mass, plain.stiffness, n_base=1, damping_matrix=damping)
        right = simulate(truth, lines(truth), force=True)
        formulation = SimpleNamespace(mass=SimpleNamespace(entries=None, free=True), geometry=SimpleNamespace(n=3))
        assert not list(force_misfit(formulation, right, truth, None))
        wrong = dataclasses.replace(right, force=1.01 * right.force)
        (told,) = force_misfit(formulation, wrong, truth, None)
        assert told.numbers == pytest.approx({"misfit": 0.01 / 1.01, "free residues": 0.0}, abs=1e-6)
        # 1 % is 1.5 times what gains known to .66 % leave: told of those known more closely.
        for tolerance, kinds in ((0.0055, ["force misfit"]), (0.0075, [])):
            stated = Calibration.stated(dataclasses.replace(wrong, gain_std=tolerance))
            assert [one.kind for one in force_misfit(formulation, wrong, truth, stated)] == kinds

    def test_of_a_damping_matrix_too(self):
        truth = storeys(matrix=True)
        assert not truth.modal_damping
        found = gain_errors(ModalEstimate.of_lines(misread(simulate(truth, lines(truth)), 1)), truth)
        # Poles are taken from modal ratios, which are not quite those of such a matrix.
        np.testing.assert_allclose(found.error, [0.0, ERROR, 0.0], atol=5e-4)
        assert found.wrong.tolist() == [1]

    def test_its_deviation_is_the_scatter_of_draws(self):
        """The sum of squares of 300 errors over their deviations is chi-squared, within 4 of its deviations."""
        truth = storeys()
        rng = np.random.default_rng(0)
        draws = [
            gain_errors(ModalEstimate.of_lines(simulate(truth, lines(truth), noise=0.01, rng=rng)), truth)
            for _ in range(100)
        ]
        squares = np.sum([(draw.error / draw.std) ** 2 for draw in draws])
        # Blocks of lines count where they scatter more than lines, so that deviations are rather too large.
        assert 0.75 * 300 < squares < 300 + 4 * np.sqrt(2 * 300)

    def test_nothing_shows_where_the_base_does_not_move_the_sensor(self, random_structure):
        truth = random_structure(np.random.default_rng(0), n=3, d=1)
        still = dataclasses.replace(simulate(truth, lines(truth)), rigid_body=truth.rigid_body * [[1.0], [0.0], [1.0]])
        assert np.isnan(gain_errors(ModalEstimate.of_lines(still), truth).error).tolist() == [False, True, False]

    @pytest.mark.parametrize("noise", [0.0, 0.003])
    def test_modes_above_the_lines_are_no_gain(self, noise):
        """Lines up to two thirds of the way to the third mode, of which the model knows nothing."""
        truth = storeys()
        f = truth.natural_frequencies
        freq = np.linspace(0.3 * f[0], f[1] + 0.5 * (f[2] - f[1]), 300)
        test = simulate(truth, freq, noise=noise, rng=0)
        two = sysid.identify(Problem(test, mass=FullMass()), strategy=sysid.Modal(modes=2), rng=0).structure
        assert two.n == 2
        assert gain_errors(ModalEstimate.of_lines(test), two).wrong.size == 0
        assert gain_errors(ModalEstimate.of_lines(misread(test, 0, 0.1)), two).error[0] == pytest.approx(0.1, abs=0.03)

    def test_deviations_hold_what_modes_above_the_lines_leave_in_the_constant(self):
        """One mode in the lines, the next near: errors are all of it and of noise, within four of the law's deviations.

        The constant beside the modes alone is the more exact by its noise, and wrong by many such deviations.
        """
        truth = storeys()
        f, rng = truth.natural_frequencies, np.random.default_rng(1)
        freq = np.linspace(0.3 * f[0], f[0] + 0.1 * (f[1] - f[0]), 300)
        one = sysid.identify(
            Problem(simulate(truth, freq), mass=FullMass()), strategy=sysid.Modal(modes=1), rng=0
        ).structure.with_residual(sysid.ResidualModes.none(3, 1))  # else it knows of those above
        draws = [
            gain_errors(ModalEstimate.of_lines(simulate(truth, freq, noise=0.01, rng=rng)), one) for _ in range(40)
        ]
        squares = np.sum([(draw.error / draw.std) ** 2 for draw in draws])
        assert squares < 120 + 4 * np.sqrt(2 * 120)

    def test_poles_that_are_slightly_off_move_neither_estimate_nor_deviation(self):
        """By 1/50 of a half width and 1/50 of the damping, which leaves several times the noise at the peaks."""
        truth = storeys()
        off = Structure(truth.mass, 1.0004 * truth.stiffness, 1.02 * truth.damping_ratios, n_base=1)
        test = simulate(truth, lines(truth), noise=0.003, rng=0)
        right, moved = gain_errors(ModalEstimate.of_lines(test), truth), gain_errors(ModalEstimate.of_lines(test), off)
        np.testing.assert_allclose(moved.std, right.std, rtol=0.05)
        assert np.all(np.abs(moved.error - right.error) < 0.1 * right.std)

    def test_one_error_of_all_is_the_bases(self):
        truth = storeys()
        test = simulate(truth, lines(truth), noise=0.003, rng=0)
        found = gain_errors(
            ModalEstimate.of_lines(dataclasses.replace(test, response=test.response / (1 + ERROR))), truth
        )
        assert found.of_base() == pytest.approx(-ERROR, abs=4e-3)
        assert gain_errors(ModalEstimate.of_lines(misread(test, 0)), truth).of_base() is None


@pytest.fixture(scope="module", params=[0.0, 0.003])
def noise(request):
    return request.param


@pytest.fixture(scope="module", params=[FullMass(), LumpedMass()], ids=["full", "lumped"])
def answer(request, noise):
    truth = storeys()
    test = simulate(truth, lines(truth), noise=noise, force=True, rng=0)
    return truth, sysid.identify(Problem(misread(test, 1), mass=request.param), rng=0)


class TestAnswer:
    def test_tells_sensor_gain_and_remedy(self, answer, noise):
        _, result = answer
        (told,) = result.of_kind("gain")
        assert (told.severity, told.channel) == ("contradicts", "sensor 2") and told.remedy
        assert told.numbers["gain"] == pytest.approx(1 + ERROR, abs=max(5 * told.numbers["std"], 1e-6))
        assert told.numbers["std"] < 1e-3 if noise else 1e-6
        assert result.judgement == "doubtful"

    def test_its_intervals_hold_the_mass_all_the_same(self, answer, noise):
        truth, result = answer
        off = np.diag(result.structure.mass)[:3] - np.diag(truth.mass)[:3]
        std = np.diag(result.uncertainty.mass)
        assert np.all(np.abs(off) < 3 * std)
        if not noise:  # where the move is all of the deviation
            np.testing.assert_allclose(np.abs(off[1]) / std[1], 1.0, atol=0.15)


def assumed(listed, *kinds):
    return [one for one in listed if one.kind in kinds]


class TestAssumptions:
    @pytest.fixture
    def across(self):
        """Two masses on a base that moves along x alone; the second, coupled to the first, moves along y only."""
        M = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.0], [0.0, 0.0, 0.0]])
        K = np.array([[5e3, 1e3, -5e3], [1e3, 9e3, -1e3], [-5e3, -1e3, 5e3]])
        return Structure(M, K, [0.01, 0.02], n_base=1)

    def test_a_gain_that_nothing_shows_is_named_where_masses_rest_on_it(self, across):
        assert across.rigid_body[:, 0] == pytest.approx([1.0, 0.0], abs=1e-12)
        test = dataclasses.replace(simulate(across, lines(across), force=True), rigid_body=[[1.0], [0.0]])
        result = sysid.identify(Problem(test, mass=FullMass()), rng=0)
        assert result.determined
        assert [one.channel for one in assumed(result.assumptions, "assumed gain")] == ["sensor 2"]
        assert assumed(result.assumptions, "assumed force gain")

    def test_none_where_all_masses_are_stated(self, across):
        test = dataclasses.replace(simulate(across, lines(across), force=True), rigid_body=[[1.0], [0.0]])
        result = sysid.identify(Problem(test, mass=sysid.KnownMass(across.mass)), rng=0)
        assert not assumed(result.assumptions, "assumed gain", "assumed force gain")


class TestTotalOfALumpedMass:
    def test_base_ring_in_the_stated_mass_is_no_contradiction_but_told(self):
        """Accelerations of 12 kg fit 15 kg as well, 3 kg of which sit on the base: matrices are 5/4 too large."""
        truth = storeys()
        right = sysid.identify(Problem(simulate(truth, lines(truth)), mass=LumpedMass(12.0)))
        ring = sysid.identify(Problem(simulate(truth, lines(truth)), mass=LumpedMass(15.0)))
        assert right.determined and ring.determined
        np.testing.assert_allclose(ring.structure.mass, 1.25 * right.structure.mass, rtol=1e-6)
        assert [one.numbers for one in assumed(ring.assumptions, "assumed total")] == [{"direction 1": 15.0}]

    @pytest.mark.parametrize(
        ("mass", "force"), [(FullMass(15.0), False), (LumpedMass(), False), (LumpedMass(15.0), True)]
    )
    def test_is_assumed_of_no_other_mass_and_not_where_the_force_contradicts(self, mass, force):
        truth = storeys()
        problem = Problem(simulate(truth, lines(truth), force=force), mass=mass)
        assert not assumed(assumptions(problem.prepared), "assumed total")

    def test_names_the_total_of_each_direction(self, random_case):
        _, problem = random_case(np.random.default_rng(3), "lumped", n=5, d=2)
        totals = problem.formulation.mass.totals.values
        (told,) = assumed(assumptions(problem.prepared), "assumed total")
        assert list(told.numbers.values()) == pytest.approx(totals)
