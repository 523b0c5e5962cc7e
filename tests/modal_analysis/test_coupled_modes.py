"""Modes that dampers couple: responses against direct solves, poles of the state matrix, first order, fits."""

import functools
from dataclasses import replace

import numpy as np
import pytest

import sysid
from sysid.jobs.changes import drawn_from
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis import coupled_modes
from sysid.modal_analysis.coupled_modes import passive, score_of_couplings
from sysid.modal_analysis.coupled_spectra import CoupledLines
from sysid.modal_analysis.fit import fit_modes
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.modal_estimate import Coupling
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.modal_model import Parameters
from sysid.modal_analysis.record_fit import RecordFit, record_modes
from sysid.modal_analysis.record_model import RecordModel
from sysid.modal_analysis.response import coupled_flexibility

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
RATE, LINES = 64.0, (0.5, 16.0)


def building(dashpot=25.0):
    """Three storeys with 1 % in all modes on a foundation, and a dashpot between floors 2 and 3, N s/m."""
    m, k = 4.0, 5000.0
    K = k * np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    full = np.block([[K, -K.sum(axis=1, keepdims=True)], [-K.sum(axis=1)[None], K.sum(keepdims=True)]])
    M = np.diag([m, m, m, 1.0])
    plain = sysid.Structure(M, full, np.full(3, 0.01), n_base=1)
    between = np.array([0.0, -1.0, 1.0])
    return sysid.Structure(M, full, n_base=1, damping_matrix=plain.damping + dashpot * np.outer(between, between))


def modes_of(structure):
    """Modes, and the off-diagonal part of Phi' C Phi."""
    omega = 2 * np.pi * structure.natural_frequencies
    modes = Modes(structure.mode_shapes, structure.participation, omega, structure.damping_ratios)
    loss = structure.normal_modes.T @ structure.damping @ structure.normal_modes
    return modes, loss - np.diag(np.diag(loss))


def record(structure, noise, rng, *, samples=2000, force=True):
    """A record of random motion, cut in motion: cosines that are no lines of it, each by a direct solve."""
    period = 7919  # a prime, longer than the record
    w = 2 * np.pi * np.arange(period // 2 + 1) * RATE / period
    inside = (w > 2 * np.pi * 0.4) & (w < 2 * np.pi * 18.0)
    drawn = (rng.standard_normal(w.size) + 1j * rng.standard_normal(w.size)) * inside
    freq = w[inside] / (2 * np.pi)
    outputs = np.zeros((4, w.size), complex)
    outputs[:3, inside] = structure.transmissibility(freq)[:, 0] * drawn[inside]
    outputs[3, inside] = structure.base_force(freq)[0, 0] * drawn[inside]
    both = np.fft.irfft(np.vstack([drawn, outputs]), n=period)[:, :samples]
    both = both + noise * both.std(axis=1, keepdims=True) * rng.standard_normal(both.shape)
    return Measurement.from_time(
        [(both[:1], both[1:4], both[4:] if force else None)], RATE, rigid_body=structure.rigid_body, band=LINES
    )


def test_motions_of_coupled_modes_are_those_of_a_direct_solve():
    truth = building()
    modes, coupling = modes_of(truth)
    freq = np.linspace(0.5, 16.0, 50)
    A = coupled_flexibility(freq, modes.omega, modes.ratios, coupling)
    q = (2 * np.pi * freq) ** 2 * np.einsum("jkl,kd->jdl", A, modes.gamma)
    M, K, C = truth.mass[:3, :3], truth.stiffness[:3, :3], truth.damping
    push = M @ truth.rigid_body_dofs + truth.mass[:3, 3:]
    for at, w in enumerate(2 * np.pi * freq):
        a = np.linalg.solve(K - w**2 * M + 1j * w * C, w**2 * push)
        np.testing.assert_allclose(modes.phi @ q[..., at], a, rtol=1e-10, atol=1e-12 * np.abs(a).max())


def test_complex_shapes_are_to_first_order_those_of_the_state_matrix():
    """Shape k is phi_k + sum_j i w_k Z_jk phi_j / (w_k² - w_j²): what the off-diagonal entries mean."""
    errors = []
    for dashpot in (0.1, 0.05):
        modes, Z = modes_of(truth := building(dashpot))
        M, K, C = truth.mass[:3, :3], truth.stiffness[:3, :3], truth.damping
        inverse = np.linalg.inv(M)
        state = np.block([[np.zeros((3, 3)), np.eye(3)], [-inverse @ K, -inverse @ C]])
        poles, shapes = np.linalg.eig(state)
        up = np.flatnonzero(poles.imag > 0)
        up = up[np.argsort(np.abs(poles[up]))]
        off = 0.0
        for k, at in enumerate(up):
            modal = modes.phi.T @ M @ shapes[:3, at]
            modal = modal / modal[k]
            apart = modes.omega[k] ** 2 - modes.omega**2
            apart[k] = np.inf
            off = max(off, np.abs(modal - np.eye(3)[k] - 1j * modes.omega[k] * Z[:, k] / apart).max())
        errors.append(off)
    # Beside the first order stand products of Z with itself and with the losses of the modes, which stay.
    assert errors[0] < 0.05 * np.abs(modes_of(building(0.1))[1]).max() / 10
    assert errors[1] < 0.6 * errors[0]


def test_slopes_of_plain_spectra_are_those_of_differences():
    rng = np.random.default_rng(1)
    truth = building()
    test = sysid.simulate(truth, np.linspace(1.0, 14.0, 40), noise=0.01, force=True, rng=0)
    weights = [(0, rng.uniform(0.5, 2.0, 4), rng.uniform(0.5, 2.0, 40))]
    model = CoupledLines(test, 3, weights, static=0)
    modes, coupling = modes_of(truth)
    x = model.pack(model.of_modes(modes, truth.rigid_body_mass, 1.2 * coupling)) * rng.uniform(0.97, 1.03, model.size)
    made = model.normal_equations(model.unpack(x), model.levels)
    step = 1e-5 * np.maximum(np.abs(x), 1e-2)
    slope = [
        (model.chi2(model.unpack(x + h * e), model.levels) - model.chi2(model.unpack(x - h * e), model.levels))
        / (2 * h)
        for h, e in zip(step, np.eye(x.size), strict=True)
    ]
    np.testing.assert_allclose(-2 * made.gradient, slope, rtol=1e-5, atol=1e-6 * np.abs(slope).max())


@pytest.fixture(scope="module")
def estimated():
    """Give a function that fits modes to a record with a dashpot, N s/m, once."""
    return functools.cache(lambda dashpot: fit_modes(record(building(dashpot), 0.005, np.random.default_rng(3))))


def beside(truth, model):
    """Parameters near the truth's, with motion at the ends of the run."""
    modes, coupling = modes_of(truth)
    ends = np.random.default_rng(1).uniform(0.5, 1.0, (3, 2))
    p = Parameters(modes, truth.rigid_body_mass, ends, np.zeros((1, model.channels, 3)), coupling)
    return model.unpack(model.pack(p) * np.random.default_rng(2).uniform(0.97, 1.03, model.size))


@pytest.mark.parametrize("force", [True, False])
def test_the_normal_matrix_of_whole_records_is_half_the_curvature_where_nothing_is_left(force):
    truth = building()
    test = record(truth, 0.005, np.random.default_rng(3), samples=600, force=force)
    model = RecordModel(test, 3, coupled=True)
    p = beside(truth, model)
    model.runs = [chunk.run._replace(outputs=chunk.run.outputs - chunk.error) for chunk in model.chunks(p)]
    levels = np.random.default_rng(4).uniform(0.5, 2.0, (1, model.channels + 1))
    normal, x = model.normal_equations(p, levels).normal, model.pack(p)
    for v in np.random.default_rng(5).standard_normal((20, x.size)):
        step = 1e-4 * v / np.sqrt(np.diag(normal))
        rise = [model.chi2(model.unpack(x + sign * step), levels) for sign in (1, -1)]
        assert sum(rise) / 2 == pytest.approx(step @ normal @ step, rel=1e-3)


@pytest.mark.parametrize("force", [True, False])
def test_modes_that_no_damper_couples_have_the_same_equations_by_either_way(force):
    """Those with couplings of zero, of gains and of modes above the lines too."""
    truth = building(0.0)
    test = record(truth, 0.005, np.random.default_rng(3), samples=600, force=force)
    model = RecordModel(test, 3, coupled=True, gains=True)
    p = beside(truth, RecordModel(test, 3, coupled=True))
    levels = np.random.default_rng(4).uniform(0.5, 2.0, (1, model.channels + 1))
    one, other = (model.normal_equations(replace(p, coupling=it), levels) for it in (None, np.zeros((3, 3))))
    size = np.sqrt(np.diag(one.normal))
    assert np.all(size > 0)
    np.testing.assert_allclose(other.normal / np.outer(size, size), one.normal / np.outer(size, size), atol=1e-10)
    np.testing.assert_allclose(other.gradient / size, one.gradient / size, atol=1e-8)
    assert other.chi2 == pytest.approx(one.chi2, rel=1e-12)
    np.testing.assert_allclose(model.gradient(replace(p, coupling=np.zeros((3, 3))), levels).gradient, other.gradient)


@pytest.mark.parametrize("last, count", [(4.0, 2), (9.0, 3)])
def test_couplings_of_modes_above_the_lines_with_each_other_are_not_asked_for(last, count):
    """They mimic what is missing of modes above; of three modes one is within 4 Hz, two within 9 Hz."""
    test = record(truth := building(), 0.005, np.random.default_rng(3), samples=600)
    test = test.at(test.freq <= last)
    model = RecordModel(test, 3, coupled=True)
    p = replace(beside(truth, model), coupling=None)
    levels = np.ones((1, model.channels + 1))
    assert score_of_couplings(model, model.normal_equations(p, levels), p)[1] == count


def test_steps_along_the_scale_of_a_mode_change_no_motion_and_others_are_sums_to_first_order():
    truth = building(0.0)
    test = record(truth, 0.005, np.random.default_rng(3), samples=600, force=False)
    model = RecordModel(test, 3)
    p = replace(beside(truth, RecordModel(test, 3, coupled=True)), coupling=None)
    levels, x = np.ones((1, model.channels + 1)), model.pack(p)
    for along in model.scales(p):
        there = model.moved(x, 0.7 * along)
        assert np.linalg.norm(there - x) > 0.5 * np.linalg.norm(along)
        assert model.chi2(model.unpack(there), levels) == pytest.approx(model.chi2(p, levels), rel=1e-10)
    step = x * np.random.default_rng(6).uniform(-1, 1, x.size)
    off = [np.abs(model.moved(x, size * step) - x - size * step).max() for size in (1e-3, 1e-4)]
    assert 0 < off[1] < 0.02 * off[0]


@pytest.mark.parametrize("dashpot", [0.0, 2.0, 25.0])
def test_whole_records_show_a_dashpot_and_no_further_modes(estimated, dashpot):
    truth, found = building(dashpot), estimated(dashpot)
    assert found.omega.size == 3
    if not dashpot:
        assert found.coupling is None
        return
    modes, Z = modes_of(truth)
    assert found.coupling is not None
    sign = np.sign(np.sum(found.phi * modes.phi, axis=0))
    off = (found.coupling.values * np.outer(sign, sign) - Z)[*found.coupling.pairs.T]
    assert np.all(np.abs(off) < 4 * found.coupling_std)
    assert np.all(found.coupling_std < 0.1 * np.abs(Z).max())
    np.testing.assert_allclose(found.omega, modes.omega, rtol=1e-3)
    np.testing.assert_allclose(found.ratios, modes.ratios, rtol=0.05)


@pytest.mark.parametrize("right", [True, False])
def test_a_mode_goes_without_which_damping_takes_energy_out(monkeypatch, right):
    """It stands for what dampers do, and a model that feeds energy in would be refused as a whole."""
    test, (modes, _) = record(building(), 0.005, np.random.default_rng(4)), modes_of(building())
    fit = record_modes(test, modes.omega, modes.ratios)
    assert len(modes.omega) == 3
    monkeypatch.setattr(coupled_modes, "_takes_energy_out", lambda fit: right or fit.model.m == 2)
    found = coupled_modes._coupled(fit, fit.parameters, 0, lambda rough: rough, None, FitMonitor())
    assert found.model.m == (3 if right else 2)


def test_a_mode_that_was_left_next_to_no_mass_gets_it_back_beside_dampers():
    """Its residues are right, as accelerations want them, and its shape is ten thousand times as large."""
    test, (modes, _) = record(truth := building(), 0.005, np.random.default_rng(4)), modes_of(building())
    fit, scale = record_modes(test, modes.omega, modes.ratios), np.array([1.0, 1.0, 1e4])
    light = fit.parameters.modes._replace(phi=modes.phi * scale, gamma=modes.gamma / scale[:, None])
    np.testing.assert_array_equal(coupled_modes._as_large(light, 2).phi, light.phi)  # of the first two alone
    large = coupled_modes._as_large(light, 3)
    np.testing.assert_allclose(large.phi @ large.gamma, light.phi @ light.gamma)
    assert np.abs(large.phi[:, 2]).max() == pytest.approx(np.abs(modes.phi[:, 0]).max())
    found = coupled_modes._coupled(
        fit, replace(fit.parameters, modes=light), 0, lambda rough: rough, None, FitMonitor()
    )
    assert found.settled and found.model.m == 3
    masses = np.sum(found.parameters.modes.gamma**2, axis=1)
    np.testing.assert_allclose(masses, np.sum(truth.participation**2, axis=1), rtol=0.05)


def test_without_a_force_modes_are_counted_and_no_coupling_is_told():
    """Accelerations leave the scale of each mode open, and with it that of the couplings."""
    found = fit_modes(record(building(), 0.005, np.random.default_rng(4), samples=6000, force=False))
    assert found.omega.size == 3 and found.coupling is None and found.record_fit.parameters.coupling is not None


def test_a_stored_fit_keeps_its_couplings(estimated):
    fit = estimated(25.0).record_fit
    again = RecordFit.from_tree(fit.to_tree(), fit.test)
    assert again.chi2 == fit.chi2
    np.testing.assert_array_equal(again.parameters.coupling, fit.parameters.coupling)
    assert again.model.chi2(again.parameters, again.levels) == fit.model.chi2(fit.parameters, fit.levels)


def test_couplings_of_some_modes_have_the_errors_of_all():
    """Conditional on fewer parameters: the joint covariance, cut down by linear algebra on the whole."""
    rng = np.random.default_rng(0)
    p, kept = 6, np.array([True, False, True])
    ours = np.array([True, True, False, True, False, True])
    pairs = np.array([[0, 1], [0, 2], [1, 2]])
    root = rng.standard_normal((p + 3, p + 3))
    joint = root @ root.T  # an information matrix: its inverse is twice the covariance
    inner = np.linalg.inv(joint[p:, p:])
    whole = Coupling(rng.standard_normal((3, 3)), pairs, -inner @ joint[p:, :p], inner / 2)
    A = joint[:p, :p] - joint[:p, p:] @ inner @ joint[p:, :p]
    some = whole.at(kept, ours, np.linalg.inv(A[np.ix_(~ours, ~ours)]), A[np.ix_(~ours, ours)])
    covariance = np.linalg.inv(joint) / 2
    at = np.append(np.flatnonzero(ours), p + 1)  # the one pair of modes that stays
    inverse = np.linalg.inv(covariance[np.ix_(at, at)])
    np.testing.assert_allclose(some.follows[0], -inverse[-1, :-1] / inverse[-1, -1], rtol=1e-9)
    np.testing.assert_allclose(some.covariance[0, 0], 1 / inverse[-1, -1], rtol=1e-9)
    np.testing.assert_array_equal(some.pairs, [[0, 1]])


def test_damping_that_feeds_energy_in_is_not_passive():
    modes, Z = modes_of(building())
    parameters = lambda factor: Parameters(modes, np.eye(1), np.zeros((3, 0)), np.zeros((1, 4, 0)), factor * Z)  # noqa: E731
    assert passive(parameters(1.0)) and not passive(parameters(20.0))


@pytest.fixture(scope="module")
def answered():
    """The answer of spectra of a structure whose modes a dashpot of 8 N s/m couples."""
    test = sysid.simulate(building(8.0), np.geomspace(1.2, 14.0, 200), noise=0.005, force=True, rng=1)
    return sysid.identify(sysid.Problem(test), rng=0)


@pytest.mark.parametrize("records", [False, True])
def test_the_answer_has_the_damping_matrix_with_honest_deviations(records, answered, tmp_path):
    truth, result = building(8.0), answered
    if records:
        result = sysid.identify(sysid.Problem(record(truth, 0.005, np.random.default_rng(6))), rng=0)
    assert result.determined and result.structure.n == 3
    off = (result.structure.damping - truth.damping) / result.uncertainty.damping
    assert np.sqrt(np.mean(off**2)) < 2.5
    sysid_file = tmp_path / "result.h5"
    result.save(sysid_file)
    again = sysid.load(sysid_file)
    np.testing.assert_array_equal(again.structure.damping, result.structure.damping)
    np.testing.assert_allclose(again.uncertainty.damping, result.uncertainty.damping, rtol=1e-6)


def test_exact_spectra_give_the_damping_matrix_to_round_off():
    truth = building()
    test = sysid.simulate(truth, np.geomspace(1.2, 14.0, 200), force=True)
    result = sysid.identify(sysid.Problem(test), rng=0)
    assert result.determined
    np.testing.assert_allclose(result.structure.damping, truth.damping, atol=1e-8 * truth.damping.max())


def test_draws_of_noise_are_about_the_damping_matrix_of_the_answer(answered):
    """Ratios as unknowns would stand for another structure, so that it tells none."""
    answer = answered
    assert answer.x is None and not answer.structure.modal_damping
    found = sysid.identify(drawn_from(answer, np.random.SeedSequence(3)), rng=0)
    assert found.residual == pytest.approx(answer.residual, rel=0.1)
    off = (found.structure.damping - answer.structure.damping) / answer.uncertainty.damping
    assert 0.1 < np.sqrt(np.mean(off**2)) < 2.5


@pytest.mark.parametrize("dashpot", [0.0, 25.0])
def test_couplings_with_modes_beyond_the_lines_accuse_no_sign(dashpot):
    """An answer in the band has no place for them: it keeps modal damping, which is then told to be too simple."""
    truth = building(dashpot)
    f = truth.natural_frequencies
    test = sysid.simulate(truth, np.geomspace(1.2, (f[1] + f[2]) / 2, 200), noise=0.003, force=True, rng=2)
    result = sysid.identify(sysid.Problem(test), rng=0)
    assert result.structure.n == 2
    told = {one.kind for one in result.contradictions}
    assert told <= {"damping", "beyond noise"} and ("damping" in told) == (dashpot > 0)
    assert result.structure.modal_damping
