"""Laws of amplitude as a term of the model of whole records: exact derivatives, and what records tell of them."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from scipy.io import loadmat

import sysid
from sysid.cli.main import main
from sysid.jobs import JobResult, spreads
from sysid.jobs.score import scored
from sysid.modal_analysis.amplitude_fit import (
    _holding,
    _in_runs,
    _judged,
    _modes_of,
    _started,
    _with_exponent,
    _without,
    _without_doubles,
    fitted_laws,
    with_laws,
)
from sysid.modal_analysis.fit import estimate, fit_modes
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.law_spectra import LawMotions
from sysid.modal_analysis.misfit import left_of
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.modal_model import ModeLaw, Parameters
from sysid.modal_analysis.record_fit import ROUGH, WHOLE, Limits, record_modes, refitted
from sysid.results.judgement import _of_its_modes
from sysid.structure.amplitude import LawForm
from tests.modal_analysis.softening_frame import (
    FALL,
    LEVEL,
    OMEGA,
    PHI,
    RATE,
    RATIOS,
    RISE,
    moved,
    recorded,
    rubbing,
    shaken,
)


@pytest.fixture(scope="module")
def test():
    return recorded((0.3, 3.0))


@pytest.fixture(scope="module")
def answer(test):
    problem = sysid.Problem(test, amplitude=sysid.AmplitudeLaw(exponents=(0.5, 1.0)))
    return sysid.identify(problem, rng=0)


@pytest.fixture(scope="module")
def plain(test):
    return sysid.identify(sysid.Problem(test), rng=0)


@pytest.mark.parametrize("form, at_rest", [(LawForm(0.5, 0.5, 10.0), False), (LawForm(2.0, -1.0, 99.0), True)])
@pytest.mark.parametrize("modes", [(0,), (0, 1), (1,)])
def test_the_gradient_of_the_fit_is_that_of_differences(test, form, at_rest, modes):
    """Of a law of the first mode, of one of the second that follows the first, and of both; none at its bounds."""
    test = replace(test, whole=replace(test.whole, at_rest=(at_rest, False)))
    fit = record_modes(test, OMEGA, RATIOS)
    factors, rng = np.array([[0.98, 1.2], [0.95, 1.4]]), np.random.default_rng(1)
    laws = tuple(
        ModeLaw(k, 1, form, np.array([0.02, 0.003]) / (1 + k), factors, level_of=None if k == 0 else 0) for k in modes
    )
    p = replace(fit.parameters, laws=laws)
    model = fit.model_of(p)
    x, exact = model.pack(p), model.normal_equations(p, fit.levels)
    unit = np.where(model.held, 0.0, 1 / np.sqrt(np.maximum(np.diag(exact.normal), 1e-300)))
    assert np.array_equal(model.pack(model.unpack(x)), x)
    for part in (model.index.phi, model.index.gamma, model.index.log_omega, model.of_laws, slice(0, model.size)):
        step = np.zeros(x.size)
        step[part] = (rng.standard_normal(x.size) * unit)[part]

        def chi2(times, step=step):
            return model.chi2(model.unpack(x + times * step), fit.levels)

        difference = (8 * (chi2(0.3) - chi2(-0.3)) - (chi2(0.6) - chi2(-0.6))) / 3.6
        size = 2 * np.abs(exact.gradient * step).sum()  # terms may cancel down to the round-off of differences
        assert difference == pytest.approx(-2 * exact.gradient @ step, abs=1e-6 * size)


@pytest.mark.parametrize("hertz", [3.5, 9.0])
@pytest.mark.parametrize("fall, within", [(0.0, 1e-4), (0.2, 1e-3)])
def test_what_a_law_adds_does_not_depend_on_its_steps(hertz, fall, within):
    """Of a burst of noise up to 48 Hz, sampled at 120 Hz: nothing where the law changes nothing, images of lines off.

    What such a load holds beyond its lines moves a mode of 9 Hz by some thousandths of the base's motion.
    """
    rng, rate, n = np.random.default_rng(0), 120.0, 4800
    white = np.convolve(rng.normal(size=n), np.sinc(0.8 * np.arange(-60, 61)) * np.hanning(121), "same")
    burst, freq = white * np.exp(-(((np.arange(n) / rate - 5.0) / 1.2) ** 2)), np.arange(1, 2300) * rate / n
    base = np.fft.rfft(burst)[None, None, 1:2300] / rate
    short = sysid.Measurement(freq, base, base.copy(), rigid_body=[[1.0]], sample_rate=rate)
    modes = Modes(np.ones((1, 1)), np.array([[1.3]]), 2 * np.pi * np.array([hertz]), np.array([0.03]))
    p = Parameters(modes, np.eye(1), np.zeros((1, 0)), np.zeros(0))
    law = ModeLaw(0, 0, LawForm(1.0, 1.0, 10 * np.std(burst)), np.array([fall, fall / 5]), np.ones((1, 2)))
    coarse, fine = (LawMotions(short, *steps).of_run(p, 0, law)[0] for steps in ((16.0, 3.0), (96.0, 24.0)))
    size = np.linalg.norm(base)
    assert np.linalg.norm(coarse - fine) < within * size
    assert np.linalg.norm(fine) > size if fall else np.linalg.norm(fine) < 1e-3 * size


def test_the_law_is_found_within_its_deviations(answer):
    (law,) = answer.structure.laws
    scale = LEVEL / law.form.level
    truth = np.concatenate([np.log([3.0, 0.012]), [FALL * scale**-0.5, RISE / scale]])
    found = np.concatenate([np.log([law.frequency, law.ratio]), law.values])
    assert np.all(np.abs(found - truth) < 5 * np.sqrt(np.diag(law.covariance)))
    assert np.sqrt(law.covariance[2, 2]) < 0.02 * law.values[0]  # and they say something
    assert [one.kind for one in answer.findings].count("amplitude law") == 1
    assert not any(one.kind == "changing" for one in answer.findings)
    assert np.allclose(answer.structure.natural_frequencies, [3.0, 8.0], rtol=2e-3)
    assert [one.numbers["mode"] for one in answer.findings if one.kind == "linear"] == [2.0]  # tried too


def test_each_mode_has_a_law_and_exponents_of_its_own(tmp_path):
    """Beside what the second mode's changes leave, a law of the first alone is not beyond chance."""
    problem = sysid.Problem(recorded((0.3, 3.0), both=True, samples=900), amplitude=sysid.AmplitudeLaw())
    answer = sysid.identify(problem, rng=0)
    first, second = answer.structure.laws
    assert (first.form[:2], second.form[:2]) == ((0.5, 1.0), (1.0, 1.0))
    for law, mode, exponent in ((first, 0, 0.5), (second, 1, 1.0)):
        scale = LEVEL / law.form.level
        truth = [*np.log([OMEGA[mode] / (2 * np.pi), RATIOS[mode]]), FALL * scale**-exponent, RISE / scale]
        found = np.concatenate([np.log([law.frequency, law.ratio]), law.values])
        assert np.all(np.abs(found - truth) < 5 * np.sqrt(np.diag(law.covariance)))
    assert [one.numbers["mode"] for one in answer.findings if one.kind == "amplitude law"] == [1.0, 2.0]
    for told, law in zip(answer.to_dict()["amplitude_laws"], answer.structure.laws, strict=True):
        unit = 5.0 / told["reference_level_m_s2"]
        w = told["frequency_at_rest_hz"] * (1 - told["fall_of_frequency"] * unit ** told["exponent_of_frequency"])
        zeta = told["damping_ratio_at_rest"] + told["rise_of_damping"] * unit ** told["exponent_of_damping"]
        assert (w, zeta) == pytest.approx(law.at(5.0), rel=1e-9) and told["mode"] == law.mode + 1
    again = sysid.load(answer.save(tmp_path / "result.h5"))
    assert [law.at(2.0) for law in again.structure.laws] == [law.at(2.0) for law in answer.structure.laws]
    assert again.problem.amplitude == sysid.AmplitudeLaw()


def test_a_mode_that_follows_the_level_of_the_first_is_found_and_predicted(tmp_path):
    asked = sysid.AmplitudeLaw(modes=[1, 2], exponents=(0.5, 1.0))
    answer = sysid.identify(sysid.Problem(recorded((0.3, 3.0), by_first=True, samples=900), amplitude=asked), rng=0)
    first, second = answer.structure.laws
    assert (first.followed, second.followed) == (0.0, pytest.approx(3.0, rel=1e-3))
    assert (first.level_of, second.level_of) == (0, 0)
    for law, mode in ((first, 0), (second, 1)):
        scale = LEVEL / law.form.level
        truth = [*np.log([OMEGA[mode] / (2 * np.pi), RATIOS[mode]]), FALL * scale**-0.5, RISE / scale]
        found = np.concatenate([np.log([law.frequency, law.ratio]), law.values])
        assert np.all(np.abs(found - truth) < 5 * np.sqrt(np.diag(law.covariance)))
    base = shaken(1.5, 77)
    truth = moved(base, by_first=True)
    again = sysid.load(answer.save(tmp_path / "result.h5"))
    in_time = again.structure.simulate(base[None], RATE)[:, : truth.shape[1]]
    assert np.linalg.norm(in_time - truth) < 0.05 * np.linalg.norm(truth - base[: truth.shape[1]])
    (told,) = (one for one in answer.findings if one.kind == "amplitude law" and one.numbers["mode"] == 2.0)
    assert told.numbers["level of mode"] == 1.0


def test_modes_that_are_one_count_once(test):
    fit = record_modes(test, np.append(OMEGA, 0.94 * OMEGA[0]), np.append(RATIOS, RATIOS[0]))
    modes = fit.parameters.modes._replace(omega=np.append(OMEGA, 0.94 * OMEGA[0]), phi=PHI[:, [0, 1, 0]])
    fit = replace(fit, parameters=replace(fit.parameters, modes=modes))
    assert _modes_of(fit, sysid.AmplitudeLaw(modes=[2, 1])) == [1, 2]
    assert _modes_of(fit, sysid.AmplitudeLaw()) == [2, 1]
    with pytest.raises(sysid.InputError, match="mode 3 .* 2 modes"):
        _modes_of(fit, sysid.AmplitudeLaw(modes=[1, 3]))


@pytest.mark.parametrize("beside", [[], [0.999]])
def test_a_mode_that_shows_at_several_levels_has_one_law(test, beside):
    """As the linear fit of a long test of levels 1:10 has three poles of one mode, and one that shows no peak."""
    omega = np.append(OMEGA[[0, 0, 0, 1]] * [0.93, 0.96, 1.0, 1.0], 0.9 * OMEGA[1] * np.ones(len(beside)))
    fit = record_modes(test, omega, np.append(RATIOS[[0, 0, 0, 1]], beside))
    assert fit.model.m == 4 + len(beside)
    found = with_laws(fit, sysid.AmplitudeLaw(modes=[1], exponents=(0.5, 1.0)), monitor=FitMonitor())
    (law,) = fitted_laws(found)
    assert found.model.m == 2  # and so two sensors have as many modes as there are
    scale = LEVEL / law.form.level
    truth = np.concatenate([np.log([3.0, 0.012]), [FALL * scale**-0.5, RISE / scale]])
    away = np.concatenate([np.log([law.frequency, law.ratio]), law.values]) - truth
    assert law.is_certain
    assert np.all(np.abs(away) < 5 * np.sqrt(np.diag(law.covariance)))


def test_where_all_modes_left_have_a_law_none_is_looked_for(monkeypatch):
    """As where a mode of its own in the linear fit becomes one with its neighbour."""
    test = recorded((0.3, 3.0), both=True, samples=900)
    fit = record_modes(test, OMEGA[[0, 0, 1]] * [0.95, 1.0, 1.0], RATIOS[[0, 0, 1]])
    monkeypatch.setattr("sysid.modal_analysis.amplitude_fit._modes_of", lambda fit, stated: [0, 1, 2])
    found = with_laws(fit, sysid.AmplitudeLaw(exponents=(0.5, 1.0)), monitor=FitMonitor())
    assert found.model.m == 2
    assert [law.frequency for law in fitted_laws(found)] == pytest.approx([3.0, 8.0], rel=0.05)


def test_two_near_modes_of_one_shape_that_are_two_stay_two(test):
    """One mode has a law; the other, linear and a tenth above, moves the sensors alike, as a tuned mass makes it."""
    w, beside = 2 * np.pi * test.freq, 2 * np.pi * 3.3
    added = 0.3 * w**2 / (beside**2 - w**2 + 0.04j * beside * w) * test.base
    both = replace(test, response=test.response + PHI[:, :1] * added)
    fit = record_modes(both, np.append(OMEGA, beside), np.append(RATIOS, 0.02))
    found = with_laws(fit, sysid.AmplitudeLaw(modes=[1], exponents=(0.5, 1.0)), monitor=FitMonitor())
    assert np.sort(found.parameters.modes.omega) / (2 * np.pi) == pytest.approx([3.0, 3.3, 8.0], rel=1e-3)
    assert [law.frequency for law in fitted_laws(found)] == pytest.approx([3.0], rel=1e-3)


@pytest.mark.parametrize(("share", "hertz", "stay"), [(0.0, 3.1, 2), (0.1, 3.3, 3)])
def test_a_second_mode_of_a_shape_stays_beside_a_law_only_where_the_records_ask_for_it(test, share, hertz, stay):
    """By squares, which take the base as exact: its noise near the peak asks for a mode that is none."""
    whole, w, beside = replace(test.whole, plain=True), 2 * np.pi * test.freq, 2 * np.pi * hertz
    added = share * w**2 / (beside**2 - w**2 + 0.04j * beside * w) * test.base
    both = replace(test, response=test.response + PHI[:, :1] * added, whole=whole)
    fit = record_modes(both, np.append(OMEGA, beside), np.append(RATIOS, 0.02))
    first = int(np.argmin(np.abs(fit.parameters.modes.omega - OMEGA[0])))
    law = _started(fit, first, (0.5, 1.0), (0.03,), ROUGH, FitMonitor())
    assert law.model.m == 3
    assert _without_doubles(law, ROUGH, FitMonitor()).model.m == stay


def test_a_law_is_judged_against_the_fit_without_it_alone(plain):
    """The first mode has a law, which gains enough for two; a law of the second, linear one is left out beside it."""
    monitor, linear = FitMonitor(), plain.prepared.modal[0].record_fit
    true = with_laws(linear, sysid.AmplitudeLaw(modes=[1], exponents=(0.5, 1.0)), monitor=monitor)
    second = int(np.argmax(true.parameters.modes.omega))
    both = _started(true, second, (0.5, 1.0), (0.0,), WHOLE, monitor)
    held, gone = _holding(both, linear, WHOLE, monitor)
    assert [law.frequency for law in fitted_laws(held)] == pytest.approx([3.0], rel=1e-3)
    assert [law.frequency for law in gone] == pytest.approx([8.0], rel=1e-3)
    assert held.likelihood == pytest.approx(true.likelihood, abs=0.1)


def test_a_law_gains_nothing_by_steps_that_the_fit_without_it_has_not_taken():
    first = record_modes(recorded((0.3, 3.0), law=False, samples=600), OMEGA, RATIOS)
    monitor, linear = FitMonitor(), refitted(first, first.parameters)
    p = linear.parameters
    off = replace(p, modes=p.modes._replace(omega=1.03 * p.modes.omega))
    few = refitted(linear, off, limits=Limits(1, 1))
    law = _started(few, 0, (0.5, 1.0), (0.0,), ROUGH, monitor)
    without = _without(law, 0, ROUGH, monitor)
    assert without.likelihood == pytest.approx(linear.likelihood, abs=0.1)
    likelier = [_judged(law, [other]).parameters.laws[0].likelier for other in (few, without)]
    assert likelier == [True, False]


def test_noise_of_the_base_does_not_stand_for_what_laws_of_friction_miss():
    fit = record_modes(recorded((0.3, 1.0, 3.0), seed=3, samples=600, by=rubbing), OMEGA, 1.3 * RATIOS)
    linear = refitted(fit, fit.parameters, monitor=FitMonitor())
    assert 0.03 < left_of(linear) < 0.1
    found = with_laws(linear, sysid.AmplitudeLaw(exponents=(0.5, -1.0)), monitor=FitMonitor())
    assert found.model.whole.plain and len(found.parameters.laws) == 2
    assert left_of(found) < 0.2 * left_of(linear)
    assert found.parameters.modes.omega[0] == pytest.approx(OMEGA[0], rel=2e-4)  # 4e-4 and more beside that noise
    assert found.parameters.modes.ratios[0] == pytest.approx(RATIOS[0], rel=0.01)


def test_a_mode_above_the_lines_at_rest_that_moves_within_them_keeps_its_law():
    """The second mode is at 8 Hz at rest, and 7 % lower at the levels of the test; lines end between."""
    test = recorded((0.3, 3.0), both=True, samples=900).in_band(0.8, 7.93)
    answer = sysid.identify(sysid.Problem(test, amplitude=sysid.AmplitudeLaw(exponents=(1.0, 1.0))), rng=0)
    assert answer.structure.natural_frequencies[1] > test.freq[-1]
    assert [law.mode for law in answer.structure.laws] == [0, 1]
    base = shaken(1.0, 77)
    missed = answer.structure.simulate(base[None], RATE) - moved(base, both=True)
    assert np.linalg.norm(missed) < 0.25 * np.linalg.norm(moved(base, both=True) - base)  # 0.7 without laws


def test_of_modes_with_laws_those_that_are_stated_are_the_structure_s():
    """Both modes follow their amplitude, and one frequency is stated: the other mode's law takes none with it."""
    stated = sysid.SpectralStiffness([2.9])
    asked = sysid.AmplitudeLaw(exponents=(1.0, 1.0))
    test = recorded((0.3, 3.0), both=True, samples=900)
    answer = sysid.identify(sysid.Problem(test, stiffness=stated, amplitude=asked), rng=0)
    assert answer.structure.natural_frequencies == pytest.approx([3.0], rel=0.03)  # true; the exponent asked is not
    assert [law.mode for law in answer.structure.laws] == [0]


def test_a_law_whose_mode_the_structure_has_not_takes_no_other_with_it(answer):
    (law,) = answer.structure.laws
    lost = replace(law, frequency=20.0)
    assert _of_its_modes([lost, law], answer.structure) == [law]
    assert _of_its_modes([replace(law, followed=20.0)], answer.structure) == []


def test_laws_that_were_left_out_stay_where_the_fit_goes_on(answer, monkeypatch):
    """As where modes that stand for all above the lines are added."""
    prepared = copy(answer.prepared)
    laws = [law.likelier for law in prepared.modal[0].laws]
    assert laws == [True, False]
    more = refitted(prepared.modal[0].record_fit, prepared.modal[0].record_fit.parameters, limits=ROUGH)
    monkeypatch.setattr("sysid.problem.prepared.with_static_modes", lambda fit, monitor: more)
    prepared.fit_records(None, FitMonitor())
    assert prepared.modal[0].record_fit.parameters is more.parameters
    assert [law.likelier for law in prepared.modal[0].laws] == laws


def test_an_unseen_run_is_predicted_far_better_than_by_a_linear_model(plain, answer):
    base = shaken(1.5, 77)
    truth = moved(base)
    unseen = sysid.Measurement.from_time(
        [(base[None, : truth.shape[1]], truth, None)], RATE, rigid_body=np.ones((2, 1)), band=(0.8, 12.0)
    )

    def missed(result):
        return np.linalg.norm(result.predict(unseen) - unseen.relative) / np.linalg.norm(unseen.relative)

    assert missed(answer) < 0.05
    assert missed(answer) < 0.25 * missed(plain)
    in_time = answer.structure.simulate(base[None], RATE)[:, : truth.shape[1]]
    assert np.linalg.norm(in_time - truth) < 0.05 * np.linalg.norm(truth - base[: truth.shape[1]])


def test_a_stored_answer_keeps_its_law(answer, tmp_path):
    again = sysid.load(answer.save(tmp_path / "result.h5"))
    assert again.structure.laws[0].at(4.0) == answer.structure.laws[0].at(4.0)
    assert again.problem.amplitude == answer.problem.amplitude
    assert [law.likelier for law in again.prepared.modal[0].laws] == [True, False]  # one was left out
    assert again.prepared.modal[0].omega == pytest.approx(answer.prepared.modal[0].omega, rel=1e-12)
    assert again.residual == pytest.approx(answer.residual, rel=1e-9)


def test_draws_tell_how_a_law_scatters(answer):
    """Of two, one as the answer, one without a law."""
    score, name = scored(answer), "mode 1: change of frequency with amplitude"
    (value, _), (std, _) = answer.structure.laws[0].change()
    assert (score.values[name], score.stds[name]) == (value, std)
    linear = replace(score, values={key: one for key, one in score.values.items() if "amplitude" not in key})
    ends = [JobResult(i, 0, True, "", np.zeros(0), 0.01, one) for i, one in enumerate((score, linear))]
    (found,) = (one for one in spreads(answer, ends) if one.name == name)
    assert (found.std, found.inside) == (std, 0.5)
    assert found.drawn == pytest.approx(abs(value) / np.sqrt(2))


def test_an_export_at_a_level_holds_the_matrices_there_and_names_it(answer, tmp_path, capsys):
    answer.save(tmp_path / "result.h5")

    def exported(name, *options):
        return main(["export", str(tmp_path / "result.h5"), str(tmp_path / name), *options])

    assert exported("rest.mat") == exported("there.mat", "--level", "2.5") == 0
    rest, there = (loadmat(tmp_path / name) for name in ("rest.mat", "there.mat"))
    linear = answer.structure.at_level(2.5)
    assert np.array_equal(rest["K"], answer.structure.stiffness)
    assert np.array_equal(there["K"], linear.stiffness)
    lam = scipy.linalg.eigh(there["K"][:2, :2], there["M"][:2, :2], eigvals_only=True)
    assert np.sqrt(lam[0]) / (2 * np.pi) == pytest.approx(answer.structure.laws[0].at(2.5)[0], rel=1e-9)
    about = [str(cell[0]) for cell in there["about"][:, 0]]
    assert sum("mode 1" in line and "2.5 m/s2" in line for line in about) == 1
    for wrong in ("-1", "nan", "high"):
        assert exported("wrong.mat", "--level", wrong) == 2
        assert len(capsys.readouterr().err.strip().splitlines()[-1]) > 0
    assert not (tmp_path / "wrong.mat").exists()


def test_a_level_of_a_structure_without_laws_is_refused(plain, tmp_path):
    with pytest.raises(sysid.InputError, match="--amplitude"):
        sysid.export(plain, tmp_path / "there.csv", level=2.5)


@pytest.mark.parametrize(("number", "exponent"), [(0, 2.0), (1, -1.0), (1, 2.0)])
def test_with_another_exponent_a_law_says_the_same_at_two_levels(test, number, exponent):
    fit = record_modes(test, OMEGA, RATIOS)
    law = ModeLaw(0, 1, LawForm(0.5, 0.5, 400.0), np.array([0.05, -0.004]), np.ones((2, 2)))
    p = replace(fit.parameters, laws=(law,))
    fit = replace(fit, parameters=p)
    other = _with_exponent(fit, number, exponent)
    levels = np.quantile(np.concatenate(_in_runs(fit, p, law)[0]), (0.3, 0.95))

    def at(p, level):
        (one,) = p.laws
        a, b = one.values * (level / one.form.level) ** np.array(one.form[:2])
        return np.array([p.modes.omega[0] * (1 - a), p.modes.ratios[0] + b])

    for level in levels:
        assert np.allclose(at(p, level), at(other, level), rtol=1e-9)
    assert other.laws[0].form[number] == exponent


def test_a_fit_that_is_stopped_keeps_the_best_so_far(plain):
    fit = plain.prepared.modal[0].record_fit
    most = []
    for after in (0, 3, 9, 27):
        calls = []

        def stop(*_, calls=calls, after=after):
            calls.append(1)
            if len(calls) > after:
                raise KeyboardInterrupt

        monitor = FitMonitor(stop)
        found = with_laws(fit, sysid.AmplitudeLaw(exponents=(0.5, 1.0)), monitor=monitor)
        assert found.stopped
        most.append(found.likelihood)
    assert most == sorted(most)
    assert most[0] == pytest.approx(fit.likelihood)


def test_a_law_that_explains_the_records_is_found_before_the_linear_fit_ends(monkeypatch):
    """A weak third mode is found beside it; where no law does, the whole linear fit stands."""
    asked = sysid.AmplitudeLaw(exponents=(0.5, 1.0))

    def whole(*_, **__):
        raise AssertionError("the whole linear fit")

    test = recorded((0.3, 3.0))
    w, weak = 2 * np.pi * test.freq, 2 * np.pi * 5.5
    added = 0.005 * w**2 / (weak**2 - w**2 + 0.02j * weak * w) * test.base
    monkeypatch.setattr("sysid.modal_analysis.fit.whole_fit", whole)
    fit = fit_modes(replace(test, response=test.response + np.array([[1.0], [-0.3]]) * added), amplitude=asked)
    assert fit.omega / (2 * np.pi) == pytest.approx([3.0, 5.5, 8.0], rel=3e-3)
    assert [law.frequency for law in fit.laws if law.is_certain] == pytest.approx([3.0], rel=1e-3)
    with pytest.raises(AssertionError, match="whole linear fit"):
        fit_modes(recorded((0.3, 3.0), law=False), amplitude=asked)


def test_a_linear_structure_is_told_to_be_one():
    test = recorded((0.3, 3.0), law=False)
    law = sysid.identify(sysid.Problem(test, amplitude=sysid.AmplitudeLaw(exponents=(0.5, 0.5))), rng=0)
    plain = sysid.identify(sysid.Problem(test), rng=0)
    assert law.structure.laws == ()
    assert [one.kind for one in law.findings if one.kind in ("linear", "amplitude law", "amplitude open")] == ["linear"]
    assert np.array_equal(law.structure.mass, plain.structure.mass)


def test_one_short_run_of_one_level_leaves_the_law_open():
    test = recorded((0.5,), noise=0.3, samples=400)
    result = sysid.identify(sysid.Problem(test, amplitude=sysid.AmplitudeLaw(exponents=(0.5, 0.5))), rng=0)
    assert result.structure.laws == ()
    assert any(one.kind == "amplitude open" for one in result.findings)


def test_a_mode_that_the_records_do_not_show_is_refused():
    test = recorded((0.3,), law=False, samples=400)
    with pytest.raises(sysid.InputError, match="mode 5"):
        sysid.identify(sysid.Problem(test, amplitude=sysid.AmplitudeLaw(modes=[5])), rng=0)


def test_spectra_have_no_amplitude():
    one = sysid.Structure(np.diag([1.0, 0.0]), 100 * np.array([[1, -1], [-1, 1]]), [0.01], n_base=1)
    test = sysid.simulate(one, np.linspace(1, 10, 50))
    with pytest.raises(sysid.InputError, match="whole records"):
        sysid.Problem(test, amplitude=sysid.AmplitudeLaw())


def test_a_law_by_the_level_of_a_mode_that_the_estimate_has_not_is_left_out(test):
    """The second mode follows the first: it may stay without a law, and the first may stay alone."""
    fit = record_modes(test, OMEGA, RATIOS)
    law = ModeLaw(1, 1, LawForm(0.5, 1.0, 10.0), np.array([0.02, 0.003]), np.ones((2, 2)), level_of=0)
    fit = replace(fit, parameters=replace(fit.parameters, laws=(law,)))
    for kept, laws in (((True, True), 1), ((False, True), 0), ((True, False), 0)):
        assert len(estimate(replace(fit, kept=np.array(kept))).laws) == laws


def test_a_law_of_a_mode_that_the_answer_has_not_is_told_and_left_out():
    """One mode is asked for, and the law is of the other."""
    law = sysid.AmplitudeLaw(modes=[2], exponents=(1.0, 1.0))
    test = recorded((0.3, 3.0), both=True)
    result = sysid.identify(sysid.Problem(test, amplitude=law), strategy=sysid.Modal(modes=1), rng=0)
    assert result.structure.n == 1
    assert not result.structure.laws
    assert not any(one.kind == "amplitude law" for one in result.findings)
    assert [one.severity for one in result.findings if one.kind == "amplitude open"] == ["caution"]
