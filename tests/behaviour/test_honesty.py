"""Claims of a result about itself where the data do not carry it: whole identifications of awkward structures."""

import numpy as np
import pytest

import sysid

QUICK = sysid.Swarm(max_iterations=15, restarts=0)


def chain(masses, springs, ratios, *, arms=None):
    """Spring chain on a moving base; `arms` are the polarities of the sensors."""
    m, k = np.asarray(masses, float), np.asarray(springs, float)
    s = np.ones(m.size) if arms is None else np.asarray(arms, float)
    K = np.diag(k + np.append(k[1:], 0)) - np.diag(k[1:], 1) - np.diag(k[1:], -1)
    K_S0 = -K.sum(axis=1, keepdims=True)
    full = np.block([[K * np.outer(s, s), s[:, None] * K_S0], [(s[:, None] * K_S0).T, k[:1, None]]])
    return sysid.Structure(np.diag(np.append(m, 0.0)), full, ratios, n_base=1)


def solve(truth, *, mass, band, force=True, noise=0.0, rng=0, lines=150, strategy=QUICK, **options):
    test = sysid.simulate(truth, np.linspace(*band, lines), noise=noise, force=force, rng=rng)
    given = [float(f"{f:.4g}") for f in truth.natural_frequencies]
    return sysid.identify(
        sysid.Problem(test, mass=mass, stiffness=sysid.SpectralStiffness(given), **options), rng=rng, strategy=strategy
    )


def parallel(masses, stiffnesses, ratios):
    """Independent oscillators side by side on one base."""
    m, k = np.asarray(masses, float), np.asarray(stiffnesses, float)
    K = np.block([[np.diag(k), -k[:, None]], [-k[None], np.array([[k.sum()]])]])
    return sysid.Structure(np.diag(np.append(m, 0.0)), K, ratios, n_base=1)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("mass", [sysid.FullMass(), sysid.LumpedMass(3.0)])
def test_one_force_cannot_separate_two_modes_at_one_pole(mass, seed):
    """Only the sum of their residues is in the data, so neither force nor a lumped mass makes M known."""
    truth = parallel([1.0, 2.0], [1000.0, 2000.0], [0.01, 0.01])
    force = isinstance(mass, sysid.FullMass)
    result = solve(truth, mass=mass, band=(2.0, 9.0), force=force, rng=seed)
    assert not result.determined


@pytest.mark.parametrize("seed", range(2))
def test_poles_closer_than_the_noise_resolves_are_not_called_known(seed):
    truth = parallel([1.0, 2.0], [1000.0, 2000.0 * 1.001**2], [0.01, 0.01])
    result = solve(truth, mass=sysid.FullMass(), band=(2.0, 9.0), noise=0.01, rng=seed)
    assert not result.determined


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01])
def test_a_mode_that_the_base_does_not_move_stays_open_with_noise_too(noise):
    """Two equal masses, each on its own spring and coupled: the second mode has no participation."""
    k = np.array([[150.0, -50.0], [-50.0, 150.0]])
    K_S0 = -k.sum(axis=1, keepdims=True)
    K = np.block([[k, K_S0], [K_S0.T, -K_S0.sum(keepdims=True)]])
    truth = sysid.Structure(np.diag([2.0, 2.0, 0.0]), K, [0.01, 0.012], n_base=1)
    result = solve(truth, mass=sysid.FullMass(), band=(0.3, 4.0), noise=noise)
    assert not result.determined


def test_modes_outside_the_lines_are_not_called_known():
    truth = chain([3.0, 4.0, 5.0], [4000.0, 3000.0, 2000.0], [0.01, 0.012, 0.015])
    f = truth.natural_frequencies
    result = solve(truth, mass=sysid.FullMass(), band=(0.2 * f[0], 1.3 * f[0]), noise=0.01)
    assert not result.determined


def test_fewer_numbers_than_unknowns_determine_nothing():
    truth = chain([3.0, 4.0, 5.0], [4000.0, 3000.0, 2000.0], [0.01, 0.012, 0.015])
    f = truth.natural_frequencies
    result = solve(truth, mass=sysid.FullMass(), band=(0.9 * f[0], 1.1 * f[-1]), lines=2)
    assert not result.determined


def test_a_good_test_with_force_is_called_known_and_is():
    truth = chain([3.0, 4.0, 5.0], [4000.0, 3000.0, 2000.0], [0.01, 0.012, 0.015])
    f = truth.natural_frequencies
    result = solve(truth, mass=sysid.FullMass(), band=(0.3 * f[0], 1.3 * f[-1]), noise=0.001)
    assert result.determined
    # The weakest mode carries some percent of the mass: its modal mass has some ten times the noise.
    np.testing.assert_allclose(np.diag(result.structure.mass)[:3], [3.0, 4.0, 5.0], rtol=0.05)


def test_what_did_not_converge_is_not_called_known():
    truth = chain([3.0, 4.0, 5.0], [4000.0, 3000.0, 2000.0], [0.01, 0.012, 0.015])

    def stop(progress):
        raise StopIteration

    test = sysid.simulate(truth, np.linspace(1.0, 9.0, 100), force=True)
    given = truth.natural_frequencies.round(2)
    problem = sysid.Problem(test, mass=sysid.FullMass(), stiffness=sysid.SpectralStiffness(given))
    result = sysid.identify(problem, rng=0, callback=stop)
    assert not result.success
    assert not result.determined
    assert result.of_kind("stopped")


@pytest.mark.parametrize("start", [0.9, 1.15, 2.0])
def test_a_force_measured_only_above_the_first_mode_is_not_blamed(start):
    """The apparent mass is negative just above a resonance; its sign says nothing there."""
    truth = chain([3.0, 4.0, 5.0], [4000.0, 3000.0, 2000.0], [0.01, 0.012, 0.015])
    f = truth.natural_frequencies
    result = solve(truth, mass=sysid.FullMass(), band=(start * f[0], 1.3 * f[-1]))
    assert result.force_residual < 1e-6
    assert result.structure.rigid_body_mass[0, 0] == pytest.approx(12.0, rel=1e-6)


def test_a_force_of_the_wrong_sign_is_told():
    truth = chain([3.0, 4.0], [4000.0, 3000.0], [0.01, 0.012])
    test = sysid.simulate(truth, np.linspace(0.2, 9.0, 100), force=True)
    wrong = sysid.Measurement(test.freq, test.base, test.response, rigid_body=test.rigid_body, force=-test.force)
    stiffness = sysid.SpectralStiffness(truth.natural_frequencies)
    with pytest.raises(sysid.InputError, match="sign"):
        sysid.identify(sysid.Problem(wrong, mass=sysid.FullMass(), stiffness=stiffness), rng=0)


def test_a_stated_total_that_the_force_contradicts_is_kept_and_told():
    truth = chain([3.0, 4.0, 5.0], [4000.0, 3000.0, 2000.0], [0.01, 0.012, 0.015])
    f = truth.natural_frequencies
    result = solve(truth, mass=sysid.FullMass(20.0, healing="rigid_body"), band=(0.3 * f[0], 1.3 * f[-1]))
    assert result.structure.rigid_body_mass[0, 0] == pytest.approx(20.0, rel=1e-9)
    (told,) = result.of_kind("stated mass")
    assert told.numbers["stated 1"] == pytest.approx(20.0)
    assert told.numbers["weighed 1"] == pytest.approx(12.0, rel=0.03)


@pytest.mark.parametrize("arms", [[1, -1, 1], [-1, -1, 1]])
def test_a_chain_is_found_whatever_the_polarity_of_its_sensors(arms):
    truth = chain([3.0, 4.0, 5.0], [4000.0, 3000.0, 2000.0], [0.01, 0.012, 0.015], arms=arms)
    test = sysid.simulate(truth, np.linspace(0.5, 9.0, 150))
    problem = sysid.Problem(
        test, mass=sysid.LumpedMass(12.0), stiffness=sysid.ChainStiffness(1000.0, 10000.0), goal=1e-6
    )
    result = sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))
    assert result.success
    assert result.determined
    np.testing.assert_allclose(problem.stiffness.values(problem.geometry, result.structure),
                               [4000.0, 3000.0, 2000.0], rtol=1e-6)  # fmt: skip


def test_two_skew_sensors_of_a_lumped_mass_weigh_what_the_force_says():
    """Both belong to one direction by the rule of ties; their masses must still fit the box."""
    s = np.sqrt(0.5)
    K = np.diag([1000.0, 3000.0])
    G = np.array([[s, s], [s, -s]])
    full = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    truth = sysid.Structure(np.diag([1.0, 3.0, 0.0, 0.0]), full, [0.01, 0.012], n_base=2)
    f = truth.natural_frequencies
    again = sysid.Swarm(max_iterations=15)  # one small swarm may end in a local minimum
    result = solve(truth, mass=sysid.LumpedMass(), band=(0.3 * f[0], 1.4 * f[-1]), goal=1e-6, strategy=again)
    np.testing.assert_allclose(np.diag(result.structure.mass)[:2], [1.0, 3.0], rtol=1e-6)


def test_levers_below_a_metre_are_not_taken_for_translations():
    G = sysid.rigid_body([[0, 0, 0.5], [0, 0, 0.9]], ["x", "x"], base_axes=["x", "ry"])
    with pytest.raises(sysid.InputError, match="base_axes"):
        sysid.Measurement([1.0, 2.0], np.ones((1, 2, 2)), np.ones((1, 2, 2)), rigid_body=G)


def test_sensors_that_move_with_the_base_are_refused():
    freq, base = np.linspace(1, 5, 20), np.ones((1, 1, 20))
    test = sysid.Measurement(freq, base, np.ones((1, 2, 20)), rigid_body=np.ones((2, 1)))
    with pytest.raises(sysid.InputError, match="no sensor moves relative"):
        sysid.Problem(test, mass=sysid.FullMass(1.0), stiffness=sysid.SpectralStiffness([2.0, 3.0]))


def test_a_solver_that_converged_to_no_fit_is_no_success():
    """Without a goal the solver's good status alone must not read as a result; the message names the usual causes."""
    truth = chain([3.0, 4.0], [4000.0, 3000.0], [0.01, 0.012])
    test = sysid.simulate(truth, np.linspace(1.0, 10.0, 120))
    stiffness = sysid.SpectralStiffness(2.5 * truth.natural_frequencies)
    result = sysid.identify(sysid.Problem(test, mass=sysid.LumpedMass(7.0), stiffness=stiffness), rng=0, strategy=QUICK)
    assert not result.success
    assert not result.determined
    assert result.findings[0].kind == "residual" and result.judgement == "no fit"


def test_a_wide_box_for_a_chain_is_searched_again_until_it_fits():
    """Two decades of stiffness hold local minima; without a goal the search must not end in one and call it a fit."""
    truth = chain([12.0, 9.0], [6000.0, 4000.0], [0.02, 0.03])
    test = sysid.simulate(truth, np.linspace(0.5, 8.0, 150), noise=0.01, rng=0)
    problem = sysid.Problem(test, mass=sysid.LumpedMass(21.0), stiffness=sysid.ChainStiffness(500.0, 50000.0))
    result = sysid.identify(problem, rng=0)
    assert result.success
    assert result.residual < 0.05


def test_results_print_as_one_line():
    truth = chain([3.0, 4.0], [4000.0, 3000.0], [0.01, 0.012])
    result = solve(truth, mass=sysid.LumpedMass(7.0), band=(1.0, 10.0))
    for thing in (result, result.problem, result.measurement, result.structure):
        assert len(repr(thing)) < 200
        assert "\n" not in repr(thing)
