"""Noise, dependent sensors and wrong records are not taken for knowledge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from sysid import Continuation, FullMass, InputError, LumpedMass, Measurement, Problem, Structure, identify, simulate
from sysid.modal_analysis.residues import Records, line_correlation

FREQ = np.linspace(2.0, 30.0, 500)


def on_springs(M_SS, K_SS, G, ratios) -> Structure:
    """Masses without coupling to the base; the base rows of K follow from rigid motion."""
    d, K_S0 = G.shape[1], -K_SS @ G
    return Structure(
        np.pad(M_SS, (0, d)), np.block([[K_SS, K_S0], [K_S0.T, G.T @ K_SS @ G]]), ratios, n_base=d, rigid_body=None
    )


@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-2])
def test_noise_does_not_tell_how_two_uncoupled_chains_share_a_total(noise):
    K = block_diag([[7000.0, -3000.0], [-3000.0, 3000.0]], [[14000.0, -5000.0], [-5000.0, 5000.0]])
    truth = on_springs(np.diag([1.0, 2.0, 1.5, 0.7]), K, np.ones((4, 1)), [0.01] * 4)
    problem = Problem(simulate(truth, FREQ, noise=noise, rng=1), mass=LumpedMass(total_mass=5.2))
    result = identify(problem, rng=0)
    assert not result.determined
    if noise:
        assert result.of_kind("noise")[0].numbers["largest"] > 0.1


@pytest.mark.parametrize("noise", [0.0, 1e-3, 1e-2])
def test_a_sensor_that_is_the_mean_of_two_others_is_no_degree_of_freedom(random_structure, noise):
    """Three accelerometers on a rigid part, beside a fourth; four modes and the force."""
    truth = random_structure(np.random.default_rng(4), 4, 1)
    freq = np.geomspace(0.5 * truth.natural_frequencies[0], 1.5 * truth.natural_frequencies[-1], 500)
    test = simulate(truth, freq, force=True)
    mean = 0.5 * (test.response[:, :1] + test.response[:, 1:2])
    response = np.concatenate([test.response[:, :2], mean, test.response[:, 3:]], axis=1)
    G = np.vstack([test.rigid_body[:2], 0.5 * test.rigid_body[:1] + 0.5 * test.rigid_body[1:2], test.rigid_body[3:]])
    rng, size = np.random.default_rng(0), np.sqrt(np.mean(np.abs(response) ** 2) / 2)
    draw = lambda shape, scale: noise * scale * (rng.normal(size=shape) + 1j * rng.normal(size=shape))  # noqa: E731
    force = test.force + draw(test.force.shape, np.sqrt(np.mean(np.abs(test.force) ** 2) / 2))
    dependent = Measurement(freq, test.base, response + draw(response.shape, size), rigid_body=G, force=force)
    result = identify(Problem(dependent, mass=FullMass()), rng=0)
    # Three sensors and a modal coordinate, which the force fixes all the same.
    assert result.determined and np.count_nonzero(result.structure.dof_modes >= 0) == 1
    assert result.residual < 1.1 * noise + 1e-9
    assert np.linalg.cond(result.structure.mass[:4, :4]) < 1e6


@pytest.mark.parametrize("force", [False, True])
def test_a_lumped_total_on_skew_sensors_is_told(force):
    """Two points with sensors at ± 45 degrees: the sum over four sensors is twice what moves in one direction."""
    c = np.sqrt(0.5)
    G = np.array([[c, c], [c, -c], [c, c], [c, -c]])
    K = np.array([[9e3, 5e2, -3e3, 0], [5e2, 12e3, 0, -4e3], [-3e3, 0, 5e3, 2e2], [0, -4e3, 2e2, 7e3]])
    truth = on_springs(np.diag([3.0, 3.0, 2.0, 2.0]), K, G, [0.01] * 4)
    test = simulate(truth, FREQ, force=force)
    result = identify(Problem(test, mass=LumpedMass(total_mass=5.0)), strategy=Continuation(starts=1), rng=0)
    assert not result.determined
    assert result.of_kind("lumped total", severity="contradicts")


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("force", [False, True])
def test_a_repeated_pole_among_weak_modes_is_found_without_noise(random_structure, seed, force):
    rng = np.random.default_rng([9, seed])
    n = int(rng.integers(4, 10))
    f = np.sort(10 ** rng.uniform(0.7, 2.0, n))
    pair = int(rng.integers(0, n - 1))
    f[pair + 1] = f[pair]
    ratios = rng.uniform(0.003, 0.05, n)
    ratios[pair + 1] = ratios[pair]
    truth = random_structure(rng, n, 2, frequencies=f, ratios=ratios)
    test = simulate(truth, np.linspace(0.6 * f[0], 1.2 * f[-1], 30 * n), force=force)
    result = identify(Problem(test, mass=FullMass(None if force else 10.0)), rng=0)
    assert result.structure.n == n
    assert result.residual < 1e-10
    if force:
        scale = np.abs(truth.mass[:n, :n]).max()
        np.testing.assert_allclose(result.structure.mass[:n, :n], truth.mass[:n, :n], atol=1e-8 * scale)


def test_a_dead_load_cell_is_named(random_structure):
    truth = random_structure(np.random.default_rng(0), 4, 2)
    test = simulate(truth, np.geomspace(1.0, 1.5 * truth.natural_frequencies[-1], 300), force=True)
    with pytest.raises(InputError, match="force is zero in y"):
        Problem(replace(test, force=test.force * np.array([1.0, 0.0])[None, :, None]), mass=FullMass())


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize(("mistake", "factor"), [("sign", -1.0), ("gain", 1.2), ("axis", 0.0)])
def test_a_sensor_of_wrong_sign_gain_or_axis_is_named(random_structure, mistake, factor, noise, request):
    if mistake != "sign":  # one beside all
        request.getfixturevalue("no_growing_errors")
    truth = random_structure(np.random.default_rng(0), 6, 2)
    f = truth.natural_frequencies
    test = simulate(truth, np.geomspace(0.4 * f[0], 1.3 * f[-1], 250), noise=noise, rng=0)
    response, G = test.response.copy(), test.rigid_body.copy()
    if mistake == "axis":
        G[2] = 0.5 * G[2, ::-1]
    else:
        response[:, 2] *= factor
    wrong = replace(test, response=response, rigid_body=G)
    told = identify(Problem(wrong, mass=FullMass(10.0)), strategy="modal").contradictions
    assert "sensor 3" in {one.channel for one in told if one.kind in ("rigid motion", "sign", "gain")}


@pytest.mark.parametrize("seed", range(3))
def test_relative_accelerations_are_told_from_absolute_ones(random_structure, seed):
    truth = random_structure(np.random.default_rng(seed), 6, 2)
    f = truth.natural_frequencies
    test = simulate(truth, np.geomspace(0.4 * f[0], 1.3 * f[-1], 500))
    wrong = replace(test, response=test.relative)
    with pytest.raises(InputError, match="responses are relative to the base, not absolute"):
        identify(Problem(wrong, mass=FullMass(10.0)), strategy="modal")


class TestLineCorrelation:
    @pytest.mark.parametrize("lines", [50, 200, 2000])
    @pytest.mark.parametrize("channels", [1, 6])
    def test_white_noise_shares_nothing(self, lines, channels):
        rng = np.random.default_rng(0)
        drawn = rng.normal(size=(100, 2, channels, 3, lines))
        found = [line_correlation(real + 1j * imaginary) for real, imaginary in drawn]
        assert found == [1.0] * 100

    def test_nor_does_noise_that_channels_share_or_that_few_lines_hold(self):
        rng = np.random.default_rng(0)
        white = rng.normal(size=(100, 2, 10, 1, 200))
        unequal = np.where(np.arange(200) < 10, 3.0, 0.1)
        for real, imaginary in white:
            error = real + 1j * imaginary
            assert line_correlation(error[:1] + 0.3 * error) == 1.0
            assert line_correlation(unequal * error) == 1.0

    @pytest.mark.parametrize(("lines", "poles"), [(50, 8), (400, 20)])
    def test_nor_does_what_a_fit_leaves_of_it(self, lines, poles):
        """Free residues of both kinds take a sixth and a tenth of all numbers, of neighbouring lines together."""
        rng, freq = np.random.default_rng(0), np.linspace(1.0, lines / 10, lines)
        omega, ratios = 2 * np.pi * np.linspace(2.0, freq[-1], poles), np.full(poles, 0.02)
        for _ in range(10):
            noise = rng.normal(size=(1, 12, lines)) + 1j * rng.normal(size=(1, 12, lines))
            records = Records(Measurement(freq, np.ones((1, 1, lines)), 1 + noise, rigid_body=np.ones((12, 1))))
            fit = records.fit(omega, ratios, velocity=True)
            left = records.in_runs(fit.left).transpose(2, 0, 1)
            assert line_correlation(left, fit.residues.size) == 1.0

    @pytest.mark.parametrize("tau", [0.0, 0.25, 0.5, 0.77])
    def test_zero_padding_to_twice_the_length_is_found_wherever_the_record_stands(self, tau):
        """White noise within half of a period: neighbours correlate by sin(pi/2)/(pi/2), those after them by nothing.

        The runs stand in their periods at times of their own.
        """
        white = np.random.default_rng(0).normal(size=(4, 2, 4000))
        at = np.array([tau, 0.1])[:, None] * np.arange(4001)
        padded = np.fft.rfft(white, n=8000) * np.exp(2j * np.pi * at)
        assert line_correlation(padded) == pytest.approx(1 + 4 / np.pi, rel=0.02)

    def test_a_hann_window_smears_over_its_main_lobe(self):
        """Its lines are (-1, 2, -1)/4 of those without a window: neighbours correlate by -2/3 and 1/6.

        Errors of cross spectra are products of two such, whose correlations are the squares.
        """
        rng = np.random.default_rng(0)

        def windowed():
            white = rng.normal(size=(20, 1, 4002)) + 1j * rng.normal(size=(20, 1, 4002))
            return 2 * white[..., 1:-1] - white[..., 2:] - white[..., :-2]

        assert line_correlation(windowed()) == pytest.approx(1 + 2 * (2 / 3 + 1 / 6), rel=0.03)
        assert line_correlation(windowed().conj() * windowed()) == pytest.approx(1 + 2 * (4 / 9 + 1 / 36), rel=0.03)

    def test_h1_of_long_records_has_it(self):
        """White noise on a rigid body: the error of H1 is all there is beside one."""
        rng = np.random.default_rng(0)
        base = rng.normal(size=(1, 100_000))
        test = Measurement.from_time(
            [(base, base + rng.normal(size=(1, 100_000)), None)],
            100.0,
            rigid_body=[[1.0]],
            estimator="h1",
            segment=1000,
        )
        assert line_correlation(test.relative) == pytest.approx(1.94, rel=0.2)

    @pytest.mark.parametrize("begins", [0.0, -50.0, 7.3])
    def test_deviations_hold_where_lines_share_their_noise_wherever_records_begin(self, begins):
        """Residues of two known poles; noise of records of 50 s that are zero-padded to 100 s."""
        freq, rng, off = np.fft.rfftfreq(6000, 1 / 60.0)[150:1500], np.random.default_rng(1), []
        omega, ratios, later = 2 * np.pi * np.array([5.0, 11.0]), np.full(2, 0.02), np.exp(2j * np.pi * freq * begins)
        for _ in range(60):
            noise = np.fft.rfft(rng.normal(size=(1, 4, 3000)), n=6000)[..., 150:1500]
            test = Measurement(freq, later[None, None], (1.0 + noise) * later, rigid_body=np.ones((4, 1)))
            records = Records(test)
            fit = records.fit(omega, ratios)
            std = np.sqrt(records.noise(fit.left, fit.residues.size) * np.einsum("kir,kir->ki", fit.spread, fit.spread))
            off.append(fit.residues / std[..., None])
        # 480 standard normal numbers; those of white noise would be off by the root of 2.
        assert 0.87 < np.sqrt(np.mean(np.square(off))) < 1.1
