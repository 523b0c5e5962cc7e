"""Modes above the lines, standing for all there together, against the sums over the true modes."""

from dataclasses import replace

import numpy as np
import pytest

import sysid
from benchmarks.band.simulated_tests import draw
from benchmarks.band.structures import structure as continuous_structure
from benchmarks.records.simulated import Modes as SimulatedModes
from benchmarks.records.simulated import Run, random_motion, with_noise
from sysid.modal_analysis import fit
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.modal_estimate import residual_of
from sysid.modal_analysis.model_order import least_of
from sysid.modal_analysis.record_model import RecordModel
from sysid.modal_analysis.residual_tests import scatter_over_blocks
from sysid.modal_analysis.spectra_modes import ModeFit
from sysid.modal_analysis.vector_fitting import Poles
from sysid.nlp import IterationMonitor
from sysid.problem import prepared
from sysid.structure.structure import Structure

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")


@pytest.fixture(scope="module")
def truth(random_structure):
    """Ten modes, of which six are far above the lines: no pole is found there."""
    frequencies = np.array([4.0, 6.5, 9.0, 12.0, 45.0, 60.0, 70.0, 85.0, 100.0, 120.0])
    return random_structure(np.random.default_rng(4), 10, 2, frequencies=frequencies, base_mass=1.0)


@pytest.fixture(scope="module")
def spectra(truth):
    """Half a per cent of noise, lines up to the fourth mode."""
    return sysid.simulate(truth, np.linspace(2.0, 15.0, 400), noise=0.005, force=True, rng=0)


@pytest.fixture(scope="module")
def found(spectra):
    return sysid.identify(sysid.Problem(spectra, mass=sysid.FullMass()), rng=0)


def low(structure, freq):
    """The part in phase of what residual modes add, over w², at a line."""
    beyond, w = structure.residual, 2 * np.pi * freq
    motion = beyond.motion(np.array([freq]))[..., 0].real / w**2
    return beyond.shapes @ motion, beyond.participation.T @ motion


def test_they_stand_for_all_modes_above_the_lines(truth, found):
    s, f, outside = found.structure, np.array([13.0]), truth.natural_frequencies > 15.0
    all_there = sysid.ResidualModes(
        truth.natural_frequencies[outside], truth.damping_ratios[outside], truth.mode_shapes[:, outside],
        truth.participation[outside],
    )  # fmt: skip
    w = 2 * np.pi * f[0]
    motion = all_there.motion(f)[..., 0].real / w**2
    expected = all_there.shapes @ motion, all_there.participation.T @ motion
    # Of the force they make a small part, which noise of its own size hides more of.
    for mine, right, within in zip(low(s, f[0]), expected, (0.05, 0.15), strict=True):
        assert np.abs(mine - right).max() < within * np.abs(right).max()
    assert s.residual.static == 2 and np.allclose(s.residual.natural_frequencies[-2:], 30.0)


def test_the_modes_in_the_lines_are_determined_within_their_deviations(truth, found):
    u, inside = found.uncertainty, truth.natural_frequencies < 15.0
    assert found.determined and found.structure.n == 4 and not found.contradictions
    for name in ("natural_frequencies", "damping_ratios"):
        off = (getattr(found.structure, name) - getattr(truth, name)[inside]) / getattr(u, name)
        assert np.sqrt(np.mean(off**2)) < 2.5 and np.abs(off).max() < 4.5
    off = (found.structure.effective_masses - truth.effective_masses[inside]) / u.effective_masses
    assert np.abs(off).max() < 4


@pytest.mark.parametrize("number", [0, 3])
def test_poles_close_above_the_lines_draw_nothing_off_the_modes_within(number):
    """Without a pole beside the static modes the last mode of this frame bends, and passes for coupled damping."""
    frame = continuous_structure(1)
    found = sysid.identify(sysid.Problem(draw(frame, number).measurement, mass=sysid.FullMass()), rng=0)
    beyond, u, last = found.structure.residual, found.uncertainty, frame.lines[1]
    assert found.determined and found.structure.n == frame.count and not found.contradictions
    assert np.all(beyond.natural_frequencies > last) and np.all(beyond.natural_frequencies < 2.001 * last)
    assert beyond.count > beyond.static
    for name, right in (("natural_frequencies", frame.frequencies), ("damping_ratios", frame.modes.zeta)):
        off = (getattr(found.structure, name) - right[: frame.count]) / getattr(u, name)
        assert np.abs(off).max() < 4


def test_one_pole_for_two_close_modes_above_the_lines_promises_little_and_gets_another():
    """Modes at 28.0 and 29.6 Hz: as one pole they look like a gain, and a right sensor was accused by 4 deviations."""
    plate = continuous_structure(59)
    found = sysid.identify(sysid.Problem(draw(plate).measurement, mass=sysid.FullMass()), rng=0)
    beyond = found.structure.residual
    assert beyond.count - beyond.static == np.count_nonzero(plate.frequencies[3:] < 30.0) == 2
    assert found.determined and not found.contradictions


def test_a_pole_beside_one_above_the_lines_leaves_the_rigid_body_mass_as_it_is():
    """One pole alone lies where residual modes need more mass than there is, which M_rb made up for (8 deviations)."""
    frame = continuous_structure(13)
    found = sysid.identify(sysid.Problem(draw(frame).measurement, mass=sysid.FullMass()), rng=0)
    off = found.structure.rigid_body_mass - frame.modes.rigid_body_mass
    assert found.determined and found.structure.n == frame.count and found.structure.residual.static == 0
    assert np.abs(off / found.uncertainty.rigid_body_mass).max() < 3


def test_no_mass_of_the_superelement_is_negative(found):
    mass = found.structure.to_craig_bampton().mass
    size = np.sqrt(np.diag(mass))
    assert np.linalg.eigvalsh(mass / np.outer(size, size))[0] > -1e-9


def test_deviations_are_those_of_a_dense_jacobian_with_the_far_pole_held(spectra, found):
    """By complex steps of the response, the pole of the static modes no unknown; a pseudo-inverse leaves the gauge."""
    s, freq, d = found.structure, spectra.freq, 2
    beyond, n = s.residual, s.n_sensors
    m, r = s.n, beyond.count
    omega = np.concatenate([2 * np.pi * s.natural_frequencies, beyond.omega])
    ratios = np.concatenate([s.damping_ratios, beyond.damping_ratios])
    free = m + r - beyond.static
    theta = np.concatenate([
        np.log(omega[:free]), np.log(ratios[:free]), np.hstack([s.mode_shapes, beyond.shapes]).ravel(),
        np.vstack([s.participation, beyond.participation]).ravel(), s.rigid_body_mass[np.triu_indices(d)],
    ])  # fmt: skip
    sizes = np.cumsum([free, free, n * (m + r), (m + r) * d])

    def records(x, freq=freq):
        """Real and imaginary parts as real-analytic functions of x, accelerations and force of both runs."""
        log_w, log_z, phi, gamma, corner = np.split(x, sizes)
        phi, gamma = phi.reshape(n, -1), gamma.reshape(-1, d)
        w_k = np.concatenate([np.exp(log_w), omega[free:]])[:, None]
        z_k = np.concatenate([np.exp(log_z), ratios[free:]])[:, None]
        w = 2 * np.pi * freq
        a, b = w_k**2 - w**2, 2 * z_k * w_k * w
        parts = np.stack([w**2 * a, -(w**2) * b]) / (a**2 + b**2)
        M = np.array([[corner[0], corner[1]], [corner[1], corner[2]]])
        of_a = np.einsum("nk,kd,pkf->pndf", phi, gamma, parts)
        of_f = np.einsum("kc,kd,pkf->pcdf", gamma, gamma, parts)
        of_f[0] += M[:, :, None]
        return [one.transpose(1, 0, 2, 3).reshape(len(one[0]), -1) for one in (of_a, of_f)]

    step = 1e-20j
    columns = [records(theta + step * one) for one in np.eye(theta.size)]
    stds = []
    for record, std in ((spectra.response, spectra.response_std), (spectra.force, spectra.force_std)):
        left = record - (spectra.predict(s) + record - spectra.relative if record is spectra.response
                         else spectra.predict_force(s))  # fmt: skip
        stds.append(np.sqrt(np.mean(np.abs(left) ** 2) / 2) if std is None else std.ravel()[0] / np.sqrt(2))
    J = np.stack([np.concatenate([c.imag.ravel() / 1e-20 / std for c, std in zip(col, stds, strict=True)])
                  for col in columns], axis=1)  # fmt: skip
    size = np.linalg.norm(J, axis=0)
    covariance = np.linalg.pinv((J / size).T @ (J / size), rcond=1e-10, hermitian=True) / np.outer(size, size)
    right = np.sqrt(np.diag(covariance))
    u = found.uncertainty
    np.testing.assert_allclose(u.natural_frequencies / s.natural_frequencies, right[:m], rtol=0.03)
    np.testing.assert_allclose(u.damping_ratios / s.damping_ratios, right[free : free + m], rtol=0.03)
    near = np.array([14.9])  # the last line is at 15 Hz: here a free pole would count most
    for part, mine in enumerate((u.transmissibility(near), u.base_force(near))):
        moved = np.stack([records(theta + step * one, near)[part].imag / 1e-20 for one in np.eye(theta.size)], axis=-1)
        by_part = moved.reshape(mine.shape[0], 2, 2, -1)  # real and imaginary, directions of the base
        variance = np.einsum("npdi,ij,npdj->nd", by_part, covariance, by_part)
        np.testing.assert_allclose(mine[..., 0], np.sqrt(variance), rtol=0.04)


@pytest.fixture(scope="module")
def whole(truth):
    """A record cut in motion, its lines up to the fourth mode; sampled far above all modes."""
    rng = np.random.default_rng(2)
    motion = random_motion(rng, 15.0, 200.0, (1.0, 30.0), correlation=np.eye(2))
    records, _ = with_noise(Run.ringing(SimulatedModes.of(truth), motion, rng).records(), rng, 0.02)
    return sysid.Measurement.from_time(
        [(records.base, records.response, records.force)], 200.0, rigid_body=truth.rigid_body, band=(2.0, 15.0)
    )


@pytest.fixture(scope="module")
def steps_once():
    """Take each step towards all modes once from the same fit: its steps begin alike whatever a fit is held to miss."""
    ends = {}

    def once(step):
        def end(of, *arguments, **options):
            if (step, id(of)) not in ends:
                ends[step, id(of)] = of, step(of, *arguments, **options)  # that fit keeps its place in memory
            return ends[step, id(of)][1]

        return end

    with pytest.MonkeyPatch.context() as patch:
        for name in ("with_couplings", "with_further_modes", "without_spurious_modes", "with_static_modes"):
            patch.setattr(fit, name, once(getattr(fit, name)))
        patch.setattr(prepared, "with_static_modes", fit.with_static_modes)
        yield


@pytest.fixture(scope="module")
def fits(fitted_once, steps_once, whole):
    """Of whole records, without them and with them."""
    without = fitted_once(whole)
    return without, fit.with_static_modes(without)


def test_whole_records_ask_for_them_too(truth, whole, fits):
    fit, more = fits
    assert more.static == 2 and 2 * (more.likelihood - fit.likelihood) > 100
    at = np.argsort(more.parameters.modes.omega)[:4]
    information = more.information()
    found = more.parameters.modes.omega[at] / (2 * np.pi)
    assert np.abs(found / truth.natural_frequencies[:4] - 1).max() < 1e-3 and information.shape[0]
    result = sysid.identify(sysid.Problem(whole, mass=sysid.FullMass()), rng=0)
    off = (result.structure.damping_ratios - truth.damping_ratios[:4]) / result.uncertainty.damping_ratios
    assert result.determined and np.abs(off).max() < 4


@pytest.mark.parametrize("much", [False, True])
def test_a_fit_that_misses_much_of_whole_records_asks_for_them_before_it_is_judged(fits, monkeypatch, much):
    """Else what modes above the lines add passes for noise of the base, and least squares take the place of noise."""
    monkeypatch.setattr("sysid.modal_analysis.fit.misses_much", lambda left: much)
    assert fit._with_all_modes(fits[0], FitMonitor()).static == 2 * much


def test_modes_that_noise_explains_beside_them_are_never_all(fits, monkeypatch):
    """They stand for others: of no modes of its own there is no fit."""
    monkeypatch.setattr("sysid.modal_analysis.model_order.joint_worth", lambda fit: lambda modes: 0.0)
    fit, omega = fits[1], fits[1].parameters.modes.omega
    within = omega < 2 * np.pi * fit.test.freq[-1]
    gone = least_of(fit)
    assert np.count_nonzero(within) > 1
    assert np.count_nonzero(gone) == np.count_nonzero(within) - 1 and not np.any(gone & ~within)


def test_a_pole_above_beside_them_may_be_undamped_and_in_the_lines_it_may_not(fits):
    """Far narrower than a line it is no mode of the structure, and need be none above the lines."""
    last = 2 * np.pi * fits[1].test.freq[-1]
    assert not least_of(with_undamped(fits[1], 1.4 * last))[0]
    assert least_of(with_undamped(fits[1], 0.5 * last))[0]


def with_undamped(fit, omega):
    """With a first mode of this frequency and no damping, whose shape is that of the last one."""
    p = fit.parameters.at(np.insert(np.arange(fit.model.m), 0, -1))
    p.modes.omega[0], p.modes.ratios[0] = omega, 1e-12
    return replace(fit, parameters=p)


def test_an_undamped_pole_above_stays_among_first_modes_until_static_ones_take_its_place(fits, monkeypatch):
    first = with_undamped(fits[0], 1.4 * 2 * np.pi * fits[0].test.freq[-1])
    assert least_of(first)[0] and not least_of(first, first=True)[0]
    monkeypatch.setattr("sysid.modal_analysis.fit.misses_much", lambda left: False)
    monkeypatch.setattr("sysid.modal_analysis.fit.with_couplings", lambda fit, *_, **__: fit)
    asked = []

    def with_static_modes(of, **_):
        asked.append(of)
        return fits[1]

    monkeypatch.setattr("sysid.modal_analysis.fit.with_static_modes", with_static_modes)
    assert fit._with_all_modes(first, FitMonitor()).static == 2 and asked == [first]


def test_static_modes_are_judged_with_the_poles_beside_them():
    """Six modes in the lines of a plate; a pole that stood for many above went, and static modes alone miss more."""
    truth = continuous_structure(29)
    assert fit.with_static_modes(fit.whole_fit(draw(truth).measurement)).static == 1


@pytest.mark.parametrize("force", [False, True])
def test_the_unknowns_of_a_model_with_them_are_what_its_normal_matrix_holds(whole, fits, force):
    """Its rank: without the far pole, transients of these modes, turns among them and, without a force, scales."""
    fit, n = fits[1], whole.n_sensors
    test, parameters, levels = whole, fit.parameters, fit.levels
    if not force:
        test, parameters = replace(whole, force=None), replace(parameters, traces=parameters.traces[:, :n])
        levels = np.delete(levels, [n, n + 1], axis=1)
    model = RecordModel(test, fit.model.m, static=2)
    equations = model.normal_equations(parameters, levels)
    assert not np.any(equations.gradient[model.held])
    size = np.sqrt(np.diag(equations.normal))
    seen = size > 0
    scaled = equations.normal[np.ix_(seen, seen)] / np.outer(size[seen], size[seen])
    lam = np.linalg.eigvalsh(scaled)
    assert np.count_nonzero(lam > 1e-12 * lam[-1]) == model.unknowns


def test_poles_that_stood_for_modes_above_the_lines_go():
    """Five modes in the lines of a beam by finite elements; without static modes a sixth is found there."""
    truth = continuous_structure(6)
    result = sysid.identify(sysid.Problem(draw(truth).measurement, mass=sysid.FullMass()), rng=0)
    assert result.structure.n == truth.count == 5 and result.structure.residual.static == 3 and result.determined


@pytest.mark.parametrize("times", [1.1, 1.5])
def test_a_pole_above_the_lines_goes_where_static_modes_do_as_well(truth, times):
    """A fit that came to no end with a pole beyond the last line; under 2 % of noise nothing is left for it to do."""
    freq = np.linspace(2.0, 15.0, 400)
    spectra = sysid.simulate(truth, freq, noise=0.02, force=True, rng=0)
    within = 2 * np.pi * truth.natural_frequencies[:4]
    omega = np.append(within, 2 * np.pi * times * freq[-1])
    poles = Poles(omega, np.append(truth.damping_ratios[:4], 0.05), 1.0)
    fit = ModeFit(spectra, poles, np.sqrt(np.diag(truth.rigid_body_mass)), IterationMonitor(None, None), 300)
    stopped = replace(fit, max_iterations=1).of_modes(np.ones(5, dtype=int))
    found = fit.with_static(stopped)
    assert stopped.status != "settled" and stopped.modes.omega.max() > 2 * np.pi * freq[-1]
    assert found.static == 2 and np.sort(found.modes.omega)[:4] == pytest.approx(within, rel=3e-3)
    assert np.sort(found.modes.omega)[4:] == pytest.approx(2 * np.pi * 2 * freq[-1])


def test_a_pole_that_noise_explains_once_they_are_there_is_no_mode():
    """Eight modes in the lines of a plate; of ten poles two are above the eighth, one of them in the lines."""
    truth = continuous_structure(56)
    result = sysid.identify(sysid.Problem(draw(truth).measurement, mass=sysid.FullMass()), rng=0)
    assert result.structure.n == truth.count == 8 and result.structure.residual.static == 1 and result.determined


def test_a_pole_dragged_to_no_damping_answers_for_one_line_and_is_no_mode():
    """Six modes in the lines of a beam in space; a seventh pole there keeps the fit from its end."""
    truth = continuous_structure(18)
    result = sysid.identify(sysid.Problem(draw(truth).measurement, mass=sysid.FullMass()), rng=0)
    assert result.success and result.structure.n == truth.count == 6


def test_more_mass_than_is_spare_is_taken_off_static_modes_without_harm_to_the_accelerations():
    """Whole records of a plate, whose likeliest static modes would leave the base a negative mass."""
    truth = continuous_structure(41)
    result = sysid.identify(sysid.Problem(draw(truth, 2).measurement, mass=sysid.FullMass()), rng=0)
    modal, s = result.modal[0], result.structure
    weighs = modal.rigid - modal.gamma.T @ modal.gamma
    assert modal.static == 2 and np.linalg.eigvalsh(weighs)[0] < 0
    form = s.to_craig_bampton().mass
    assert np.linalg.eigvalsh(form)[0] > -1e-9 * np.abs(form).max()
    assert result.determined and result.residual < 1.05 * residual_of(modal, modal.modes)


def test_scatter_over_blocks_leaves_what_is_held_out(fits):
    """Where noise alone is left it is about the information, of which nothing is known of a pole that is held."""
    B, A = scatter_over_blocks(fits[1]), fits[1].information()
    assert np.all(np.isfinite(B)) and not np.any(B[fits[1].model.held[: len(B)]])
    assert np.trace(B) == pytest.approx(np.trace(A), rel=0.4)


def test_a_structure_without_modes_above_has_none(random_structure):
    truth = random_structure(np.random.default_rng(5), 4, 2, frequencies=[4.0, 6.5, 9.0, 12.0])
    test = sysid.simulate(truth, np.linspace(2.0, 15.0, 300), noise=0.01, force=True, rng=1)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    assert isinstance(result.structure, Structure) and result.structure.residual.count == 0
    assert result.structure.at_sensors and result.determined


def test_without_a_force_they_answer_at_the_sensors_and_weigh_nothing(truth):
    """Nothing tells their masses: none is made up, in the base force as in the superelement."""
    test = sysid.simulate(truth, np.linspace(2.0, 15.0, 400), noise=0.005, rng=0)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass(40.0)), rng=0)
    s = result.structure
    assert s.residual.count and s.n == 4 and not result.determined
    assert result.residual < 1.05 * test.residual(truth)
    assert np.abs(s.residual.participation).max() < 1.1e-3 * np.sqrt(40.0)
    mass = s.to_craig_bampton().mass
    size = np.sqrt(np.diag(mass))
    assert np.linalg.eigvalsh(mass / np.outer(size, size))[0] > -1e-9
