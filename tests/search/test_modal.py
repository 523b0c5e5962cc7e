"""Strategy "modal": no swarm, no frequencies; checked against structures that are known."""

import dataclasses
from functools import partial

import numpy as np
import pytest

import sysid
from benchmarks.band.simulated_tests import draw
from benchmarks.band.structures import structure as continuous
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.modal_fit import Modes
from sysid.models.stiffness_and_damping import ProportionalDamping
from sysid.problem.prepared import Prepared
from sysid.search import modal, modal_program
from sysid.search.modal import degrees_of_freedom
from sysid.search.session import DeferredInterrupt, Session

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")


def structure(seed, n, d):
    """Random full, coupled mass and stiffness, damping from 0.3 % (below the swarm's box) to 4 %."""
    rng = np.random.default_rng([seed, n, d])
    G = np.zeros((n, d))
    G[np.arange(n), rng.integers(0, d, n)] = 1.0
    root = rng.normal(size=(n + d, n + d))
    M = root @ root.T + np.eye(n + d)
    f = np.cumsum(rng.uniform(1.5, 8.0, n)) + 2.0
    L = np.linalg.cholesky(M[:n, :n])
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    K = L @ (Q * (2 * np.pi * f) ** 2) @ Q.T @ L.T
    full = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    return sysid.Structure(M, full, rng.uniform(0.003, 0.04, n), n_base=d)


def lines(truth):
    f = truth.natural_frequencies
    return np.geomspace(0.7 * f[0], 1.3 * f[-1], 60 * truth.n)


@pytest.mark.parametrize(("n", "d"), [(3, 1), (5, 2), (8, 3)])
@pytest.mark.parametrize("seed", range(2))
def test_with_base_force_the_structure_itself_is_found(seed, n, d):
    truth = structure(seed, n, d)
    test = sysid.simulate(truth, lines(truth), force=True)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), strategy="modal", rng=0)
    assert result.success
    assert result.strategy == "modal"
    assert result.residual < 1e-10
    for name in ("mass", "stiffness", "damping"):
        true, found = getattr(truth, name), getattr(result.structure, name)
        np.testing.assert_allclose(found[:n, :n], true[:n, :n], atol=1e-8 * np.abs(true).max())


@pytest.mark.parametrize("healing", ["trace", "rigid_body"])
@pytest.mark.parametrize("seed", range(2))
def test_accelerations_alone_are_matched_with_the_stated_total_and_called_open(seed, healing):
    truth = structure(seed, 6, 2)
    test = sysid.simulate(truth, lines(truth))
    problem = sysid.Problem(test, mass=sysid.FullMass(40.0, healing=healing))
    result = sysid.identify(problem, strategy="modal", rng=0)
    assert result.success
    assert result.residual < 1e-10
    assert not result.determined
    np.testing.assert_allclose(problem.mass.total(problem.geometry, result.structure.mass), 40.0, rtol=1e-9)
    n = truth.n
    invariant = np.linalg.solve(truth.mass[:n, :n], truth.stiffness[:n, :n])
    found = np.linalg.solve(result.structure.mass[:n, :n], result.structure.stiffness[:n, :n])
    np.testing.assert_allclose(found, invariant, atol=1e-7 * np.abs(invariant).max())


@pytest.mark.parametrize("seed", range(2))
def test_noise_is_fitted_to_its_floor(seed):
    truth = structure(seed, 5, 2)
    test = sysid.simulate(truth, lines(truth), noise=0.01, force=True, rng=seed)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), strategy="modal", rng=0)
    assert result.success
    assert result.residual == pytest.approx(test.residual(truth), rel=0.05)


def test_modes_that_passed_one_another_in_the_fit_keep_their_own_damping(monkeypatch):
    """The structure numbers its modes by frequency, whatever their order where the fit ends."""
    true = structure(0, 4, 2)
    test = sysid.simulate(true, lines(true), noise=0.01, force=True, rng=0)
    ended = modal.ended

    def moved(*given):
        return dataclasses.replace(end := ended(*given), modes=end.modes.at([2, 0, 3, 1]))

    monkeypatch.setattr(modal, "ended", moved)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), strategy="modal", rng=0)
    assert result.structure.damping_ratios == pytest.approx(true.damping_ratios, rel=0.05)
    assert result.residual < 0.011


def test_given_frequencies_do_not_matter_and_seeds_neither():
    truth = structure(0, 4, 1)
    test = sysid.simulate(truth, lines(truth))
    given = sysid.SpectralStiffness(truth.natural_frequencies.round(2))
    problem = sysid.Problem(test, mass=sysid.FullMass(10.0), stiffness=given)
    first, second = (sysid.identify(problem, strategy="modal", rng=seed) for seed in (0, 1))
    assert first.residual < 1e-10
    np.testing.assert_array_equal(first.x, second.x)


def test_other_models_are_refused_by_name():
    truth = structure(1, 4, 1)
    problem = sysid.Problem(
        sysid.simulate(truth, lines(truth)),
        mass=sysid.FullMass(10.0),
        damping=ProportionalDamping((0.0, 1.0), (0.0, 0.01)),
    )
    with pytest.raises(sysid.InputError, match="modal"):
        sysid.identify(problem, strategy="modal")


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("d", [1, 2])
def test_more_modes_than_sensors_stand_as_modal_coordinates_beside_them(d, force):
    truth = structure(2, 5, d)
    full = sysid.simulate(truth, lines(truth), force=force)
    few = sysid.Measurement(
        full.freq, full.base, full.response[:, :3], rigid_body=full.rigid_body[:3], force=full.force,
        base_axes=full.base_axes,
    )  # fmt: skip
    result = sysid.identify(sysid.Problem(few, mass=sysid.FullMass()), strategy="modal")
    s = result.structure
    assert result.success and result.determined is force and result.x is None
    assert (s.n, s.n_sensors) == (5, 3)
    assert result.residual < 1e-10
    np.testing.assert_array_equal(s.recovery, np.eye(3, 5))
    np.testing.assert_allclose(s.natural_frequencies, truth.natural_frequencies, rtol=1e-9)
    if force:
        assert result.force_residual < 1e-10
        np.testing.assert_allclose(s.rigid_body_mass, truth.rigid_body_mass, rtol=1e-8)
        same = truth.to_craig_bampton().mass, s.to_craig_bampton().mass
        np.testing.assert_allclose(np.abs(same[1]), np.abs(same[0]), rtol=1e-7, atol=1e-9 * np.abs(same[0]).max())
    assert result.of_kind("search")


@pytest.mark.parametrize("chosen", [None, ["s2", "s4", 5]])
def test_fewer_modes_than_sensors_are_recovered_from_the_sensors_chosen(chosen):
    """Eight sensors on a structure whose motion three modes make: the five others follow exactly."""
    truth, rng = structure(3, 3, 2), np.random.default_rng(0)
    recovery = np.vstack([np.eye(3), rng.normal(size=(5, 3))])
    G = np.clip(recovery @ truth.rigid_body, -0.7, 0.7)
    axes = np.column_stack([G, np.sqrt(1 - np.sum(G**2, axis=1))])
    wide = sysid.Structure(
        truth.mass, truth.stiffness, truth.damping_ratios, n_base=2, recovery=recovery, rigid_body=G,
        sensors=[sysid.Sensor(f"s{i}", (0, 0, float(i)), axis) for i, axis in enumerate(axes.tolist())],
    )  # fmt: skip
    test = sysid.simulate(wide, lines(truth), force=True)
    strategy = sysid.Modal(sensors=chosen)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), strategy=strategy)
    s = result.structure
    assert result.success and result.determined
    assert (s.n, s.n_sensors) == (3, 8)
    assert result.residual < 1e-10 and result.force_residual < 1e-10
    at = [int(np.flatnonzero((s.recovery == row).all(axis=1))[0]) for row in np.eye(3)]
    if chosen is not None:
        assert at == [2, 4, 5]
    np.testing.assert_allclose(s.recovery, recovery @ np.linalg.inv(recovery[at]), atol=1e-9)
    # The mass over the chosen sensors is the truth's in those coordinates.
    T = np.linalg.inv(recovery[at])
    np.testing.assert_allclose(s.mass[:3, :3], T.T @ truth.mass[:3, :3] @ T, rtol=1e-7, atol=1e-9)


def test_sensors_that_do_not_tell_the_modes_apart_are_refused():
    truth = structure(2, 4, 1)
    problem = sysid.Problem(sysid.simulate(truth, lines(truth)), mass=sysid.FullMass())
    for stated, words in ((["no such"], "is no sensor"), ([0, 0], "twice")):
        with pytest.raises(sysid.InputError, match=words):
            sysid.identify(problem, strategy=sysid.Modal(sensors=stated))


def test_a_repeated_pole_is_two_modes_where_the_base_force_weighs_them():
    """Two equal oscillators along x and y: one pole, a residue of rank two."""
    truth = structure(1, 4, 2)
    omega = 2 * np.pi * truth.natural_frequencies
    omega[2] = omega[1]
    ratios = truth.damping_ratios.copy()
    ratios[2] = ratios[1]
    L, G = np.linalg.cholesky(truth.mass[:4, :4]), truth.rigid_body
    K = L @ (L.T @ truth.normal_modes * omega**2) @ (L.T @ truth.normal_modes).T @ L.T
    full = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    truth = sysid.Structure(truth.mass, (full + full.T) / 2, ratios, n_base=2)
    result = sysid.identify(
        sysid.Problem(sysid.simulate(truth, lines(truth), force=True), mass=sysid.FullMass()), strategy="modal"
    )
    assert result.success and result.determined, result.undetermined
    assert result.residual < 1e-10
    np.testing.assert_allclose(result.structure.mass, truth.mass, rtol=1e-6, atol=1e-8 * truth.mass.max())
    np.testing.assert_allclose(
        result.structure.stiffness, truth.stiffness, rtol=1e-6, atol=1e-8 * truth.stiffness.max()
    )


def test_a_wrong_sign_in_the_symbolic_residual_alone_is_no_success(monkeypatch):
    """An estimate is no end: IPOPT judges it by another form of the residual, and both must agree."""
    right, truth = modal_program.modal_gains, structure(0, 2, 1)
    problem = sysid.Problem(sysid.simulate(truth, lines(truth), force=True, noise=0.01, rng=0), mass=sysid.FullMass())
    assert sysid.identify(problem, strategy="modal", rng=0).success
    for signs in ((-1, 1), (1, -1)):
        wrong = partial(lambda signs, *of: tuple(s * g for s, g in zip(signs, right(*of), strict=True)), signs)
        monkeypatch.setattr(modal_program, "modal_gains", wrong)
        assert not sysid.identify(problem, strategy="modal", rng=0).success


def test_a_callback_can_stop_it():
    truth = structure(0, 4, 1)
    problem = sysid.Problem(sysid.simulate(truth, lines(truth), noise=0.02, rng=0), mass=sysid.FullMass(10.0))

    def stop(progress):
        raise StopIteration

    result = sysid.identify(problem, strategy="modal", callback=stop)
    assert not result.success
    assert result.message == "the callback stopped the search"


def within(result, truth, by):
    """True where mass, stiffness and damping are those of the truth, relative to the largest entry of each."""
    for name in ("mass", "stiffness", "damping"):
        true, found = getattr(truth, name), getattr(result.structure, name)
        np.testing.assert_allclose(found, true, atol=by * np.abs(true).max(), err_msg=name)


class TestStructuredMass:
    """Lumped and known masses: through the modes to the model as it stands."""

    @staticmethod
    def problem(random_case, mass, n, d, *, noise, given, seed=0):
        truth, made = random_case(np.random.default_rng([seed, n, d]), mass, n=n, d=d)
        f = truth.natural_frequencies
        count = (60 if noise else 30) * n  # what is exact is so on any number of lines
        test = sysid.simulate(truth, np.geomspace(0.5 * f[0], 1.2 * f[-1], count), noise=noise, rng=seed)
        stiffness = made.stiffness if given else sysid.SpectralStiffness()
        return truth, sysid.Problem(test, mass=made.mass, stiffness=stiffness)

    @pytest.mark.parametrize("mass", ["lumped", "known"])
    @pytest.mark.parametrize(("n", "d", "given"), [(4, 1, False), (4, 1, True), (6, 3, False)])
    def test_without_noise_it_is_exact(self, random_case, n, d, mass, given):
        truth, problem = self.problem(random_case, mass, n, d, noise=0.0, given=given)
        result = sysid.identify(problem, rng=0)
        assert result.strategy == "modal"
        assert result.success and result.determined, result.undetermined
        assert result.residual < 1e-10
        within(result, truth, 1e-9)

    @pytest.mark.parametrize("mass", ["lumped", "known"])
    @pytest.mark.parametrize("seed", range(2))
    def test_with_noise_it_ends_at_the_floor(self, random_case, seed, mass):
        """Least squares leave less than the truth does, and less by no more than as many unknowns can take."""
        truth, problem = self.problem(random_case, mass, 4, 2, noise=0.01, given=False, seed=seed)
        result = sysid.identify(problem, rng=0)
        assert result.success and result.determined, result.undetermined
        test, p = problem.measurement, problem.n_variables
        floor = test.residual(truth)
        taken = (p + 6 * np.sqrt(2 * p)) / (2 * test.response.size)
        assert floor * np.sqrt(1 - taken) < result.residual < floor
        within(result, truth, 0.05)


@pytest.mark.parametrize("n", [6, 8])
@pytest.mark.parametrize("seed", range(2))
def test_six_base_directions_with_force_give_the_whole_structure(random_structure, seed, n):
    """Rotations too: moments, products of inertia, the coupling of every sensor to all six."""
    truth = random_structure(np.random.default_rng(seed), n=n, d=6)
    test = sysid.simulate(truth, lines(truth), force=True)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    assert result.strategy == "modal"
    assert result.success and result.determined, result.undetermined
    assert result.residual < 1e-11 and result.force_residual < 1e-11
    within(result, truth, 1e-9)
    rigid = truth.rigid_body_mass
    np.testing.assert_allclose(result.structure.rigid_body_mass, rigid, atol=1e-10 * np.abs(rigid).max())


def complex_noise(rng, shape):
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


@pytest.mark.parametrize("runs", [2, 3])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_runs_that_move_the_base_in_all_directions_at_once(random_structure, noise, runs):
    rng = np.random.default_rng(runs)
    truth = random_structure(rng, n=5, d=2)
    freq = lines(truth)
    base = complex_noise(rng, (runs, 2, freq.size))
    response = np.einsum("sdf,rdf->rsf", truth.transmissibility(freq), base)
    force = np.einsum("edf,rdf->ref", truth.base_force(freq), base)
    response, force = (
        x + noise * np.sqrt(np.mean(np.abs(x) ** 2)) * complex_noise(rng, x.shape) for x in (response, force)
    )
    test = sysid.Measurement(freq, base, response, rigid_body=truth.rigid_body, force=force)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    assert result.success and result.determined, result.undetermined
    assert result.residual <= test.residual(truth) + 1e-11
    within(result, truth, max(1e-9, 3 * noise))


def test_a_sensor_that_is_stated_to_be_noisy_spoils_nothing(random_structure):
    """One of four with 100 times the noise: errors as small as their bound, and an order larger where all weigh alike.

    Frequencies and damping ratios of four structures; the root mean square of 32 normal numbers.
    """
    stated, alike, bound = [], [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        truth = random_structure(rng, n=4, d=2)
        clean = sysid.simulate(truth, lines(truth))
        std = 0.003 * np.sqrt(np.mean(np.abs(clean.relative) ** 2)) * np.array([[1.0], [100.0], [1.0], [1.0]])
        response = clean.response + std * complex_noise(rng, clean.response.shape)
        poles = np.concatenate([truth.natural_frequencies, truth.damping_ratios])
        for given, errors in ((std, stated), (np.full_like(std, np.mean(std)), alike)):
            test = sysid.Measurement(clean.freq, clean.base, response, rigid_body=truth.rigid_body, response_std=given)
            result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass(10.0)), rng=0)
            assert result.structure.n == 4
            found = np.concatenate([result.structure.natural_frequencies, result.structure.damping_ratios])
            errors.append(found / poles - 1)
            if given is std:
                u = result.uncertainty
                bound.append(np.concatenate([u.natural_frequencies, u.damping_ratios]) / poles)
    in_bounds = np.array(stated) / np.array(bound)
    assert 0.7 < np.sqrt(np.mean(in_bounds**2)) < 1.35
    rms = [np.sqrt(np.mean(np.array(errors) ** 2, axis=0)) for errors in (stated, alike)]
    assert np.all(rms[1] > 5 * rms[0])


@pytest.mark.parametrize("seed", range(2))
def test_time_records_of_a_random_test_with_force(random_structure, seed):
    """H1 from records in steady state, 1 % noise, lines a tenth of the narrowest half-power width apart.

    Frequencies read off the peaks are stated: the bias of H1 there, more than its scatter, would pass for more modes.
    """
    rng = np.random.default_rng(seed)
    truth = random_structure(rng, n=3, d=2, ratios=[0.04, 0.03, 0.03], frequencies=np.array([4.0, 7.0, 11.0]))
    rate, count = 64.0, 64 * 480
    freq = np.fft.rfftfreq(count, 1 / rate)[1:]
    paths = truth.transmissibility(freq), truth.base_force(freq)
    runs = []
    for _ in range(2):
        shake = np.fft.rfft(rng.normal(size=(2, count)))[:, 1:]
        spectra = [shake, *(np.einsum("sdf,df->sf", path, shake) for path in paths)]
        base, *answers = (np.fft.irfft(np.pad(s, ((0, 0), (1, 0))), count) for s in spectra)
        runs.append((base, *(a + 0.01 * a.std() * rng.normal(size=a.shape) for a in answers)))
    test = sysid.Measurement.from_time(
        runs, rate, rigid_body=truth.rigid_body, estimator="h1", segment=64 * 40, band=(2.5, 15.0)
    )
    stiffness = sysid.SpectralStiffness([4.02, 6.97, 11.05])
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass(), stiffness=stiffness), rng=0)
    assert result.strategy == "modal"
    assert result.success
    assert result.structure.n == 3
    np.testing.assert_allclose(result.structure.natural_frequencies, truth.natural_frequencies, rtol=1e-3)
    np.testing.assert_allclose(result.structure.damping_ratios, truth.damping_ratios, rtol=0.05)
    within(result, truth, 0.03)


@pytest.mark.parametrize("alike", [False, True])
def test_the_motions_of_modes_that_nearly_share_a_pole_are_judged_not_their_shapes(alike):
    """Their shapes are large and nearly parallel; sum and difference of their motions are as large as any other."""
    freq, split = np.linspace(2.0, 30.0, 600), 1e-4
    omega = 2 * np.pi * np.array([7.0, 15.0, 15.0 * (1 + split)])
    ratios, gamma = np.full(3, 0.03), np.array([[3.0], [2.0], [2.0]])
    together, apart = np.array([0.2, 0.4, 0.1]), np.array([0.01, -0.02, 0.015])
    if alike:
        apart = 0.1 * together
    phi = np.column_stack([[0.1, 0.2, 0.4], together / 2 - apart / split, together / 2 + apart / split])
    s = 2j * np.pi * freq
    gain = -(s**2) / (omega[:, None] ** 2 + s**2 + 2 * (ratios * omega)[:, None] * s)
    motion = phi @ (gamma * gain)
    noise = 0.003 * np.abs(motion).mean() * complex_noise(np.random.default_rng(0), motion.shape)
    base = np.ones((1, 1, 600), dtype=complex)
    test = sysid.Measurement(freq, base, (1 + motion + noise)[None], rigid_body=np.ones((3, 1)))
    chosen = degrees_of_freedom(
        sysid.Problem(test, mass=sysid.FullMass(1.0)).prepared, Modes(phi, gamma, omega, ratios), None
    )
    shapes = np.linalg.svd(phi / np.linalg.norm(phi, axis=0), compute_uv=False)
    assert shapes[-1] < 1e-3 * shapes[0]
    assert (chosen.sensors.size, chosen.modes.size) == ((2, 1) if alike else (3, 0))


@pytest.mark.parametrize(("n", "m"), [(60, 2), (30, 30)])
def test_many_sensors_that_all_modes_move_alike_are_one_motion_whatever_noise_adds(n, m):
    """Residues of least squares scatter by noise in all n sensors and m modes."""
    freq, rng = np.linspace(2.0, 40.0, 300), np.random.default_rng(0)
    omega, ratios = 2 * np.pi * np.linspace(6.0, 34.0, m), np.full(m, 0.02)
    s = 2j * np.pi * freq
    gain = -(s**2) / (omega[:, None] ** 2 + s**2 + 2 * (ratios * omega)[:, None] * s)
    motion = rng.normal(size=(n, 1)) * gain.sum(axis=0)
    noise = 0.01 * np.abs(motion).mean()
    motion = motion + noise * complex_noise(rng, motion.shape)
    phi = np.linalg.lstsq(np.hstack([gain.real, gain.imag]).T, np.hstack([motion.real, motion.imag]).T, rcond=None)[0].T
    base, std = np.ones((1, 1, 300), complex), np.full(motion.shape, noise)[None]  # stated, as to find it takes long
    test = sysid.Measurement(freq, base, (1 + motion)[None], rigid_body=np.ones((n, 1)), response_std=std)
    modes = Modes(phi, np.ones((m, 1)), omega, ratios)
    chosen = degrees_of_freedom(sysid.Problem(test, mass=sysid.FullMass(1.0)).prepared, modes, None)
    assert (chosen.sensors.size, chosen.modes.size) == (1, m - 1)


@pytest.mark.parametrize("settled", [True, False])
def test_an_estimate_that_did_not_settle_is_no_success(random_structure, settled):
    """Its modes are the answer all the same: IPOPT ends where it begins."""
    truth = random_structure(np.random.default_rng(9), n=3, d=1)
    test = sysid.simulate(truth, np.linspace(1.0, 60.0, 200), force=True, noise=0.01, rng=0)
    size = 3 * 3 + 3 + 3 + 3 + 1
    estimate = dataclasses.replace(
        ModalEstimate.of_lines(test), phi=truth.mode_shapes, gamma=truth.participation,
        omega=2 * np.pi * truth.natural_frequencies, ratios=truth.damping_ratios, rigid=truth.rigid_body_mass,
        information=1e6 * np.eye(size), settled=settled,
    )  # fmt: skip
    prepared = Prepared(sysid.Problem(test, mass=sysid.FullMass()), [estimate])
    with DeferredInterrupt() as interrupt:
        outcome = sysid.Modal().run(prepared, Session([], interrupt), None)
    assert outcome.success is settled
    assert "Solve_Succeeded" in outcome.message
    np.testing.assert_allclose(outcome.structure.natural_frequencies, truth.natural_frequencies, rtol=1e-9)
    np.testing.assert_allclose(outcome.structure.mass, truth.mass, rtol=1e-6, atol=1e-8 * truth.mass.max())


def test_statistics_that_lead_far_off_the_records_give_way_to_the_lines():
    """A light mode just above the lines has a mass that the estimate leaves more than open."""
    test = draw(continuous(5), 2).measurement
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), strategy="modal", rng=0)
    assert result.success and result.residual < 0.05


def test_modes_far_above_the_lines_that_stand_for_a_gain_are_left_out_where_they_move_alike(monkeypatch):
    """Of a frame with five in the lines ten were found, and their normal equations were singular: nothing was told."""
    # Couplings of so many modes take most of the time.
    monkeypatch.setattr("sysid.modal_analysis.spectra_modes.with_couplings_of_lines", lambda modal, *_: modal)
    test = draw(continuous(7), 1).measurement
    misread = dataclasses.replace(test, base=0.98 * test.base)
    result = sysid.identify(sysid.Problem(misread, mass=sysid.FullMass()), strategy="modal", rng=0)
    assert ("gain", "base x") in [(one.kind, one.channel) for one in result.contradictions]
    np.testing.assert_allclose(result.structure.natural_frequencies, continuous(7).frequencies[:5], rtol=1e-4)
