"""Poles from the data against structures whose poles are known."""

from dataclasses import replace

import numpy as np
import pytest

import sysid
from benchmarks.band import structures as continuous
from benchmarks.band.simulated_tests import draw
from sysid import InputError, Measurement, Problem, simulate
from sysid.modal_analysis import vector_fitting
from sysid.modal_analysis.complex_frequency import PolesAndResidues, noise_level
from sysid.modal_analysis.relocation import relocate
from sysid.modal_analysis.residues import Records, SubsetFits
from sysid.modal_analysis.vector_fitting import find_poles, poles_near


def structure(rng, n, d, *, near=0.0):
    """Random full mass and stiffness; `near` > 0 puts two modes that fraction apart."""
    axes = rng.integers(0, d, n)
    G = np.zeros((n, d))
    G[np.arange(n), axes] = 1.0
    root = rng.normal(size=(n + d, n + d))
    M = root @ root.T + np.eye(n + d)
    f = np.sort(10 ** rng.uniform(0.5, 1.8, n))
    if near:
        f[n // 2] = f[n // 2 - 1] * (1 + near)
        f.sort()
    L = np.linalg.cholesky(M[:n, :n])
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    K = L @ (Q * (2 * np.pi * f) ** 2) @ Q.T @ L.T
    full = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    return sysid.Structure(M, full, rng.uniform(0.004, 0.04, n), n_base=d)


def lines(truth, count=60):
    f = truth.natural_frequencies
    return np.geomspace(0.7 * f[0], 1.3 * f[-1], count * truth.n)


@pytest.mark.parametrize("near", [0.0, 0.01])
@pytest.mark.parametrize(("n", "d"), [(3, 1), (6, 2), (9, 3)])
@pytest.mark.parametrize("seed", range(3))
def test_without_noise_number_and_poles_are_exact(seed, n, d, near):
    truth = structure(np.random.default_rng([seed, n]), n, d, near=near)
    found = find_poles(simulate(truth, lines(truth)))
    assert found.omega.size == n
    np.testing.assert_allclose(found.omega, 2 * np.pi * truth.natural_frequencies, rtol=1e-9)
    np.testing.assert_allclose(found.ratios, truth.damping_ratios, rtol=1e-7)
    assert found.residual < 1e-10


@pytest.mark.parametrize("seed", range(8))
def test_with_noise_no_mode_is_invented_and_no_strong_one_is_missed(seed):
    """A mode is strong where its part of the records is ten times the noise; 1 % noise."""
    rng = np.random.default_rng(seed)
    truth = structure(rng, int(rng.integers(4, 9)), int(rng.integers(1, 4)))
    test = simulate(truth, lines(truth), noise=0.01, rng=rng)
    found, omega, w = find_poles(test), 2 * np.pi * truth.natural_frequencies, 2 * np.pi * test.freq
    g = w**2 / (omega[:, None] ** 2 - w**2 + 2j * (truth.damping_ratios * omega)[:, None] * w)
    size = np.linalg.norm(truth.mode_shapes, axis=0) * np.linalg.norm(truth.participation, axis=1)
    part = np.linalg.norm(g, axis=1) * size
    noise = np.sqrt(test.relative.size) * test.response_std.flat[0]
    distance = np.abs(found.omega[:, None] / omega - 1)
    assert np.all(distance.min(axis=0)[part >= 10 * noise] < 0.01)
    assert np.all(distance.min(axis=1) < 0.02)
    assert found.omega.size <= truth.n


def test_runs_whose_base_moves_in_all_directions_at_once():
    rng = np.random.default_rng(0)
    truth = structure(rng, 5, 2)
    freq = lines(truth)
    base = rng.normal(size=(3, 2, freq.size)) + 1j * rng.normal(size=(3, 2, freq.size))
    response = np.einsum("sdf,rdf->rsf", truth.transmissibility(freq), base)
    found = find_poles(Measurement(freq, base, response, rigid_body=truth.rigid_body))
    np.testing.assert_allclose(found.omega, 2 * np.pi * truth.natural_frequencies, rtol=1e-9)


def test_a_problem_finds_the_frequencies_that_it_is_not_given():
    truth = structure(np.random.default_rng(3), 4, 1)
    problem = Problem(simulate(truth, lines(truth)), mass=sysid.FullMass(10.0), goal=1e-6)
    omega = 2 * np.pi * truth.natural_frequencies
    np.testing.assert_allclose(problem.formulation.stiffness.spectrum, omega, rtol=1e-9)
    np.testing.assert_allclose(problem.poles.omega, omega, rtol=1e-9)
    result = sysid.identify(problem, rng=0, strategy=sysid.Swarm(max_iterations=20))
    assert result.success
    found = ", ".join(f"{f:.4g}" for f in truth.natural_frequencies)
    assert any(f": {found} Hz" in line for line in result.history.log)


def test_a_band_without_a_mode_is_refused():
    truth = structure(np.random.default_rng(4), 4, 1)
    f = truth.natural_frequencies
    test = simulate(truth, np.linspace(0.05 * f[0], 0.1 * f[0], 200), noise=0.05, rng=0)
    with pytest.raises(InputError, match="no mode stands out"):
        find_poles(test)


def test_too_few_lines_are_refused():
    truth = structure(np.random.default_rng(5), 4, 1)
    with pytest.raises(InputError, match="too few"):
        find_poles(simulate(truth, np.linspace(1, 60, 8)))


def test_where_lines_are_few_so_are_spare_poles():
    truth = structure(np.random.default_rng(5), 4, 1)
    found = find_poles(simulate(truth, np.linspace(1, 60, 12)))  # which determine 5 poles, not the usual 10
    np.testing.assert_allclose(found.omega, 2 * np.pi * truth.natural_frequencies, rtol=1e-9)


def building(dashpot):
    """Three storeys with 1 % in all modes, and a dashpot between floors 2 and 3, N s/m."""
    m, k = 4.0, 5000.0
    K = k * np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    full = np.block([[K, -K.sum(axis=1, keepdims=True)], [-K.sum(axis=1)[None], K.sum(keepdims=True)]])
    M = np.diag([m, m, m, 0.0])
    plain = sysid.Structure(M, full, np.full(3, 0.01), n_base=1)
    between = np.array([0.0, -1.0, 1.0])
    return sysid.Structure(M, full, n_base=1, damping_matrix=plain.damping + dashpot * np.outer(between, between))


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01])
@pytest.mark.parametrize("dashpot", [1.0, 5.0, 25.0, 60.0])
def test_damping_that_is_not_classical_does_not_multiply_poles(dashpot, noise):
    """Three poles: those of the state matrix."""
    truth = building(dashpot)
    values = np.linalg.eigvals(truth.to_state_space().A)
    values = values[values.imag > 0]
    values = values[np.argsort(np.abs(values))]
    f = truth.natural_frequencies
    test = simulate(truth, np.geomspace(0.5 * f[0], 1.3 * f[-1], 120), noise=noise, rng=0)
    found = find_poles(test)
    assert found.omega.size == 3
    np.testing.assert_allclose(found.omega, np.abs(values), rtol=noise + 1e-10)
    np.testing.assert_allclose(found.ratios, -values.real / np.abs(values), rtol=5 * noise + 1e-9)


def test_where_velocities_leave_round_off_no_further_pole_is_tried(monkeypatch):
    truth = building(25.0)
    f = truth.natural_frequencies
    test = simulate(truth, np.geomspace(0.5 * f[0], 1.3 * f[-1], 120))
    monkeypatch.setattr(vector_fitting, "_with_another", lambda *of: pytest.fail("another pole is tried"))
    assert find_poles(test).omega.size == 3


@pytest.mark.parametrize("poles", [[0, 1, 2], [0, 1, 1, 2]])
def test_a_strong_mode_just_above_the_lines_that_lost_its_pole_is_found_again(poles):
    """The second time in the place of a pole too many."""
    rng, freq = np.random.default_rng(3), np.linspace(2.0, 20.0, 300)
    w, omega, zeta = 2 * np.pi * freq, 2 * np.pi * np.array([4.0, 9.0, 14.0, 21.8]), np.array([0.01, 0.015, 0.01, 0.02])
    g = w**2 / (omega[:, None] ** 2 - w**2 + 2j * (zeta * omega)[:, None] * w)
    residues = rng.normal(size=(4, 3, 2)) * np.array([1, 1, 1, 4])[:, None, None]
    G = np.eye(2)[[0, 0, 1]]
    response = np.einsum("knd,kf->dnf", residues, g) + G.T[..., None]
    response += 0.003 * (rng.normal(size=response.shape) + 1j * rng.normal(size=response.shape))
    records = Records(Measurement(freq, np.eye(2)[..., None] * np.ones(freq.size), response, rigid_body=G))
    start = omega[poles] * np.where(np.arange(len(poles)) == 2, 1.003, 1.0)
    found = vector_fitting._with_another(records, start, zeta[poles], vector_fitting._Progress(None, records))
    np.testing.assert_allclose(np.sort(found[0]), omega, rtol=1e-4)


@pytest.mark.parametrize(("n", "d"), [(4, 2), (6, 2), (6, 3)])
@pytest.mark.parametrize("seed", range(4))
def test_a_pair_of_modes_much_closer_than_they_are_wide_is_told_apart(seed, n, d):
    """0.3 % apart at 0.1 % noise, with damping ratios of 0.4 to 4 %."""
    truth = structure(np.random.default_rng([seed, n, d]), n, d, near=0.003)
    found = find_poles(simulate(truth, lines(truth), noise=0.001, rng=seed))
    assert found.omega.size == n
    np.testing.assert_allclose(found.omega, 2 * np.pi * truth.natural_frequencies, rtol=3e-4)
    np.testing.assert_allclose(found.ratios, truth.damping_ratios, rtol=0.05)


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("sensors", [1, 2, 3])
def test_more_modes_than_sensors(sensors, noise):
    truth = structure(np.random.default_rng(11), 6, 2)
    test = simulate(truth, lines(truth), noise=noise, rng=0)
    few = Measurement(
        test.freq, test.base, test.response[:, :sensors], rigid_body=test.rigid_body[:sensors], base_axes=test.base_axes
    )
    found = find_poles(few)
    assert found.omega.size == 6
    np.testing.assert_allclose(found.omega, 2 * np.pi * truth.natural_frequencies, rtol=max(1e-9, noise))
    if noise == 0:
        np.testing.assert_allclose(found.ratios, truth.damping_ratios, rtol=1e-7)


class TestPolesNear:
    @pytest.mark.parametrize("noise", [0.0, 0.001])
    @pytest.mark.parametrize("seed", range(3))
    def test_frequencies_read_off_a_picture_are_polished_to_the_poles(self, seed, noise):
        truth = structure(np.random.default_rng(seed), 5, 2)
        omega = 2 * np.pi * truth.natural_frequencies
        off = 1 + 0.5 * truth.damping_ratios * np.array([1, -1, 1, -1, 1])
        test = simulate(truth, lines(truth), noise=noise, rng=seed)
        found = poles_near(test, omega * off, 0.05)
        np.testing.assert_allclose(found.omega, omega, rtol=noise + 1e-10)
        np.testing.assert_allclose(found.ratios, truth.damping_ratios, rtol=50 * noise + 1e-9)
        assert found.residual < 2 * noise + 1e-10

    @pytest.mark.parametrize("seed", [0, 2, 3, 4, 5])
    def test_one_from_which_a_fit_ends_elsewhere_is_named(self, seed):
        truth = structure(np.random.default_rng(seed), 4, 2)
        stated = truth.natural_frequencies * [1.0, 1.2, 1.0, 1.0]
        with pytest.raises(InputError, match=f"stated natural frequencies .*{stated[1]:.5g}.* Hz does not stand out"):
            poles_near(simulate(truth, lines(truth)), 2 * np.pi * stated, 0.02)

    def test_frequencies_stated_twice_count_once(self):
        truth = structure(np.random.default_rng(1), 3, 1)
        omega = 2 * np.pi * truth.natural_frequencies
        found = poles_near(simulate(truth, lines(truth)), omega[[0, 1, 1, 2]], 0.05)
        np.testing.assert_allclose(found.omega, omega, rtol=1e-10)


def broadband(truth, freq, runs, noise, rng):
    """Runs that move the base in all directions at once, their responses with noise that lines share."""
    shape = (runs, truth.n_base, freq.size)
    base = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    relative = np.einsum("sdf,rdf->rsf", truth.transmissibility(freq), base)
    white = rng.normal(size=relative.shape) + 1j * rng.normal(size=relative.shape)
    smeared = white + np.roll(white, 1, axis=-1)
    return Measurement(freq, base, relative + noise * np.abs(relative).mean() * smeared, rigid_body=truth.rigid_body)


def left_by(records, omega, ratios, velocity):
    """Residual of least squares on these poles, of all channels."""
    X = records.functions(omega, ratios, velocity=velocity).dense()
    return records.data - X @ np.linalg.lstsq(X, records.data, rcond=None)[0]


@pytest.mark.parametrize("velocity", [False, True])
def test_fits_on_subsets_are_least_squares_on_these_poles_alone(velocity):
    rng = np.random.default_rng(7)
    truth = structure(rng, 4, 2)
    records = Records(broadband(truth, lines(truth, 30), 3, 0.05, rng))
    omega = np.sort(2 * np.pi * np.concatenate([truth.natural_frequencies, 1.2 * truth.natural_frequencies]))
    ratios = rng.uniform(0.005, 0.05, omega.size)
    fits = SubsetFits(records, omega, ratios, velocity=velocity)
    inputs = 2 * (1 + velocity)
    assert fits.per_pole == inputs * truth.n_sensors + 2
    for kept in (np.arange(8), np.array([0, 3, 4, 6])):
        worth, squared_error = fits.worth(kept)
        left = left_by(records, omega[kept], ratios[kept], velocity)
        without = [np.delete(kept, k) for k in range(kept.size)]
        rise = [np.sum(left_by(records, omega[k], ratios[k], velocity) ** 2) - np.sum(left**2) for k in without]
        assert squared_error == pytest.approx(np.sum(left**2), rel=1e-10)
        np.testing.assert_allclose(worth, np.array(rise) / records.noise(left, kept.size * fits.per_pole), rtol=1e-7)


@pytest.mark.parametrize("runs", [1, 3])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_step_of_vector_fitting_ends_at_the_zeros_of_the_function_that_all_unknowns_together_give(noise, runs):
    """Residues of all channels and the coefficients of sigma in one system of equations."""
    rng = np.random.default_rng(8)
    truth = structure(rng, 3, 1)
    records = Records(broadband(truth, lines(truth, 20), runs, noise, rng))
    blocks = records.principal(9)
    omega, ratios = 2 * np.pi * truth.natural_frequencies * [0.98, 1.03, 0.99], np.full(3, 0.02)

    def functions(s):
        over = 1 / (omega[:, None] ** 2 + s**2 + 2 * (ratios * omega)[:, None] * s)
        return np.concatenate([over, s * over])

    s = 2j * np.pi * records.freq
    sigma = np.concatenate([np.ones((1, s.size)), functions(s)])
    rows = []
    channels = sum(len(channels) for *_, channels in blocks)
    at = 0
    for base, _, records_of_run in blocks:
        for record in records_of_run:
            answer = np.zeros((s.size, channels, 6), complex)
            answer[:, at] = (-(s**2) * functions(s) * base[0]).T
            rows.append(np.hstack([(record * sigma).T, -answer.reshape(s.size, -1)]))
            at += 1
    system = np.vstack([part(block) for block in rows for part in (np.real, np.imag)])
    fixed = np.concatenate([sigma.real.sum(axis=1), np.zeros(system.shape[1] - 7)]) * np.sqrt(records.size) / s.size
    system = np.vstack([system, fixed])
    scale = np.linalg.norm(system, axis=0)
    wanted = np.append(np.zeros(len(system) - 1), np.sqrt(records.size))
    c = (np.linalg.lstsq(system / scale, wanted, rcond=None)[0] / scale)[:7]

    found, loss = relocate(records, blocks, omega, ratios, lambda: None)
    zeros = found * (-loss + 1j * np.sqrt(1 - loss**2))
    terms = c * np.concatenate([np.ones((1, 3)), functions(zeros)]).T
    assert np.all(np.abs(terms.sum(axis=1)) < 1e-7 * np.abs(terms).sum(axis=1))


class TestMonitor:
    @pytest.fixture
    def measured(self):
        """Without stated noise: its level follows from the poles."""
        truth = structure(np.random.default_rng(2), 4, 2)
        test = simulate(truth, lines(truth, 30), noise=0.01, rng=0)
        return Measurement(test.freq, test.base, test.response, rigid_body=test.rigid_body)

    @staticmethod
    def searches(test):
        stated = find_poles(test).omega
        return [
            lambda monitor: find_poles(test, monitor=monitor),
            lambda monitor: poles_near(test, 1.01 * stated, 0.05, monitor=monitor),
            lambda monitor: PolesAndResidues.of(test, monitor=monitor),
            lambda monitor: noise_level(test, monitor=monitor),
        ]

    def test_is_told_the_number_of_iterations_and_the_residual_down_to_the_noise(self, measured):
        for search in self.searches(measured):
            told = []
            search(lambda *news, told=told: told.append(news))
            iterations, residuals = np.array(told).T
            assert set(np.diff(iterations)) <= {0, 1}
            assert iterations[-1] >= 3
            assert np.all((residuals > 0) & (residuals <= 1 + 1e-12))
            assert residuals[-1] == pytest.approx(0.01, rel=0.1)

    def test_what_it_raises_passes_through(self, measured):
        class StopError(InputError):
            pass

        for search in self.searches(measured):
            for calls in (1, 3):
                count = iter(range(1, 100))

                def stop(*_, count=count, calls=calls):
                    if next(count) == calls:
                        raise StopError("enough")

                with pytest.raises(StopError):
                    search(stop)
                assert next(count) == calls + 1

    def test_is_told_between_the_channels_of_a_step_and_between_all_removals(self, measured):
        """At least once for each of the 8 principal channels, and once for each pole removed of ten."""
        told = []
        poles = find_poles(measured, monitor=lambda *news: told.append(news))
        first = [i for i, _ in told].index(1)
        assert first >= 8
        assert told[-1][0] >= 10 - poles.omega.size


def storeys():
    """Three storeys, 4 kg and 5000 N/m each, 1 % damping, on a base of 1 kg."""
    K = 5000.0 * np.array([[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 1, 0], [-1, 0, 0, 1]])
    return sysid.Structure(np.diag([4.0, 4.0, 4.0, 1.0]), K, [0.01, 0.01, 0.01], n_base=1)


@pytest.mark.parametrize("error", [0.05, 0.2])
def test_a_wrong_gain_of_one_sensor_makes_no_pole_below_the_lines(error):
    """What it leaves is a constant, as a mode far below answers, but of one sensor alone."""
    truth = storeys()
    test = simulate(truth, lines(truth), noise=0.003, rng=0)
    found = find_poles(replace(test, response=test.response * np.array([[1.0], [1.0 + error], [1.0]])))
    assert np.all(found.omega > 2 * np.pi * test.freq[0])
    f = found.omega / (2 * np.pi)
    assert all(np.min(np.abs(f - one)) < 1e-3 * one for one in truth.natural_frequencies)


@pytest.mark.parametrize("unit", [True, False])
def test_a_wrong_gain_of_the_base_makes_no_pole_below_the_lines(unit):
    """All sensors show it, each as it moves with the base."""
    test, error = draw(continuous.structure(7)).measurement, 0.02
    misread = replace(test, base=(1 + error) * test.base)
    if unit:
        base = test.base[:, :1]
        misread = replace(
            test, base=np.ones_like(test.base), response=test.response / base / (1 + error), force=None,
            response_std=test.response_std / np.abs(base), force_std=None,
        )  # fmt: skip
        assert misread.has_unit_runs
    assert np.all(find_poles(misread).omega > 2 * np.pi * test.freq[0])


def test_modes_below_the_lines_have_their_pole_and_cost_none_at_their_other_end():
    """A plane frame whose lines begin above its first mode: its other modes are found, the last one weak."""
    truth = continuous.structure(1)
    f = truth.frequencies
    cut = replace(truth, lines=(f[0] + 0.42 * (f[1] - f[0]), truth.lines[1]))
    found = find_poles(draw(cut).measurement).omega / (2 * np.pi)
    assert all(np.min(np.abs(found - one)) < 2e-3 * one for one in f[1:3])
    assert np.any(found < cut.lines[0])
