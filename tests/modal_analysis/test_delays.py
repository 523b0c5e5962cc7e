"""Delays of channels: exact ones of spectra and of records cut in motion, none on one clock, slopes, what is stored."""

from dataclasses import replace

import numpy as np
import pytest

import sysid
from benchmarks.band.above_first_mode import cut
from benchmarks.band.simulated_tests import draw
from benchmarks.band.structures import structure as continuous
from benchmarks.records.simulated import Records, Run, four_storeys
from sysid.measurement.channels import without_delays
from sysid.measurement.whole import WholeRecords
from sysid.modal_analysis.delays import (
    Clock,
    Delays,
    _clocks,
    _joined,
    _Late,
    _with_further_poles,
    delays_beyond_chance,
    find_delays,
)
from sysid.modal_analysis.direct_terms import beside_poles
from sysid.modal_analysis.first_modes import _newly_late, first_modes, rough_fit, shadows_of
from sysid.modal_analysis.fit import whole_fit
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.record_fit import ROUGH, on_turned, record_modes, refitted
from sysid.modal_analysis.residual_tests import delays_left, delays_of, with_shared_clocks

SETTING = replace(four_storeys(150.0), duration=40.0)
FREQ = np.linspace(1.3, 16.0, 300)
MS = 1e-3


def spectra(delays, seed=0, noise=0.01):
    """Unit runs of the storeys, channels late by so much, s: of the sensors, then of the force."""
    clean = sysid.simulate(SETTING.structure, FREQ, force=True)
    late = without_delays(clean, -np.asarray(delays))
    rng, parts = np.random.default_rng(seed), {}
    for name in ("response", "force"):
        record = getattr(late, name)
        std = noise * np.sqrt(np.mean(np.abs(record) ** 2, axis=2, keepdims=True))
        real, imaginary = rng.standard_normal((2, *record.shape)) / np.sqrt(2)
        parts |= {name: record + std * (real + 1j * imaginary), f"{name}_std": std}
    return replace(late, **parts)


def record(delays, seed=0):
    """A record of the storeys, cut in motion, whose late channels are those of the same motion at earlier times."""
    rng = np.random.default_rng(seed)
    run = SETTING.run(rng)

    def earlier(delay):
        turned = run.motion.amplitudes * np.exp(-1j * run.motion.omega * delay)
        motion = replace(run.motion, amplitudes=turned)
        return Run(run.modes, motion, run.free * np.exp(-run.modes.poles * delay)).records()

    *sensors, force = (earlier(delay) for delay in delays)
    response = np.stack([part.response[i] for i, part in enumerate(sensors)])
    late = Records(run.records().base, response, force.force, SETTING.sample_rate)
    noisy, _ = SETTING.with_noise(late, rng)
    return sysid.Measurement.from_time(
        [(noisy.base, noisy.response, noisy.force)], SETTING.sample_rate, band=SETTING.lines,
        rigid_body=SETTING.structure.rigid_body,
    )  # fmt: skip


LATE = [
    [0, 2 * MS, 0, 0, 0], [0.5 * MS] * 5, [0, 0, 0, 0, -3 * MS], [0, 50 * MS, -50 * MS, 0, 30 * MS],
    [0, 0, 0, 0, 140 * MS], [0, 0, 0, 0, -900 * MS], [0, -430 * MS, 0, 0, 0], [-440 * MS] * 5,
]  # fmt: skip


@pytest.mark.parametrize("delays", LATE)
def test_delays_of_spectra_are_found_and_no_others(delays):
    found = Clock.of(spectra(delays)).delays
    np.testing.assert_array_equal(found.values != 0, np.array(delays) != 0)
    late = found.values != 0
    assert np.all(np.abs(found.values - delays)[late] < 4 * found.std[late])
    assert found.of_base == (len(set(delays)) == 1)
    assert found.of_base or np.all(found.std[~late] == 0)


@pytest.mark.parametrize("delays", LATE[:4])
def test_delays_of_records_cut_in_motion_are_found_with_the_modes(delays):
    test = record(delays)
    fit = whole_fit(test, Clock.of(test).delays.values)
    found, late = delays_of(fit), np.array(delays) != 0
    np.testing.assert_array_equal(found.values != 0, late)
    assert np.all(np.abs(found.values - delays)[late] < 4 * found.std[late])
    assert fit.parameters.modes.omega.size == 4
    f = SETTING.structure.natural_frequencies
    np.testing.assert_allclose(np.sort(fit.parameters.modes.omega) / (2 * np.pi), f, rtol=2e-3)
    left = delays_left(fit)
    assert left is None or np.all(np.abs(left) <= found.std)


def test_a_fit_finds_the_delay_that_was_left_in():
    test = record([0, 0.1 * MS, 0, 0, 0])
    found = delays_of(whole_fit(test, np.zeros(5)))
    assert np.count_nonzero(found.values) == 1
    assert abs(found.values[1] - 0.1 * MS) < 4 * found.std[1]


def test_first_modes_tell_which_channels_are_late_and_settle_by_how_much():
    """Beside what they settle nothing is left, though a step from delays far off ends short of them."""
    late = np.array([0, 4.0, 0, 4.0, 0]) * MS
    found, first = first_modes(record(late), np.zeros(5), FitMonitor())
    std = delays_of(first).std
    np.testing.assert_array_equal(found != 0, late != 0)
    assert np.all(np.abs(found - late)[late != 0] < 4 * std[late != 0])
    assert first.parameters.modes.omega.size == 4


def test_a_channel_that_hardly_tells_its_delay_is_on_the_clock_of_a_late_one(monkeypatch):
    """What a model misses may be a delay of its own; that of another is no further number, and the records show it."""
    test = record([0, 8 * MS, 0, 8 * MS, 0])
    response, rng = test.response.copy(), np.random.default_rng(1)
    real, imaginary = rng.standard_normal((2, *response[:, 3].shape))
    response[:, 3] += 0.6 * np.sqrt(np.mean(np.abs(response[:, 3]) ** 2)) * (real + 1j * imaginary)
    noisy = replace(test, response=response)
    shared = with_shared_clocks(rough_fit(noisy, FitMonitor()), np.array([0, 8 * MS, 0, 0, 0]))
    np.testing.assert_array_equal(shared, np.array([0, 8, 0, 8, 0]) * MS)
    monkeypatch.setattr("sysid.modal_analysis.residual_tests._missed", lambda _: True)
    late, fit = first_modes(noisy, np.zeros(5), FitMonitor())
    assert late[1] == late[3] == pytest.approx(8 * MS, rel=0.03) and not np.any(late[[0, 2, 4]])
    std = delays_of(fit).std
    assert std[1] == std[3] > 0  # of one number


def test_what_turned_records_hold_at_their_ends_is_fitted_before_the_modes_move(monkeypatch):
    test = record([0, 30 * MS, 0, 0, 0])
    fit = rough_fit(test, FitMonitor())
    monkeypatch.setattr("sysid.modal_analysis.record_fit.refitted", lambda fit, p, **_: replace(fit, parameters=p))
    turned = on_turned(fit, without_delays(test, np.array([0, 30 * MS, 0, 0, 0])))
    model, p, before = turned.model, turned.parameters, fit.parameters
    np.testing.assert_array_equal(p.modes.phi, before.modes.phi)
    slope = model.gradient(p, fit.levels).gradient[model.kept : model.coupling.start]
    other = model.gradient(replace(p, traces=0 * p.traces), fit.levels).gradient[model.kept : model.coupling.start]
    assert np.abs(slope).max() < 1e-6 * np.abs(other).max()


def test_a_weak_mode_beside_a_strong_one_does_not_stand_for_a_late_channel():
    """Beside each mode one of a hundredth of its participation, which explains what is late as far as it can."""
    late, structure = [0, 2 * MS, 0, 0, 0], SETTING.structure
    test = record(late)
    omega, ratios = 2 * np.pi * structure.natural_frequencies, structure.damping_ratios
    poles = {"omega": np.append(omega, 1.002 * omega), "ratios": np.append(ratios, ratios)}
    fit = record_modes(test, **poles)
    modes = fit.parameters.modes._replace(**poles)
    size = np.linalg.norm(modes.gamma[:4], axis=1, keepdims=True)
    weak = modes._replace(gamma=np.vstack([modes.gamma[:4], 0.01 * size]))
    np.testing.assert_array_equal(shadows_of(weak), np.repeat([False, True], 4))
    assert not np.any(shadows_of(weak.at(slice(4))))
    fit = replace(fit, parameters=fit.parameters.with_modes(weak, fit.parameters.ends))
    fit = refitted(fit, fit.parameters, limits=ROUGH)
    found = _newly_late(fit, np.zeros(5), FitMonitor(), 25.0)
    np.testing.assert_array_equal(np.flatnonzero(found), [1])
    assert found[1] == pytest.approx(2 * MS, rel=0.02)


def test_delays_are_put_back_only_where_the_fit_is_no_worse_without_them(monkeypatch):
    """Of a model that misses much all deviations are large."""
    known = delays_of
    monkeypatch.setattr("sysid.modal_analysis.fit.delays_of", lambda fit: replace(known(fit), std=np.ones(5)))
    assert np.count_nonzero(known(whole_fit(record([0, 0.3 * MS, 0, 0, 0]), np.zeros(5))).values) == 1


@pytest.mark.parametrize("seed", range(2))
def test_channels_on_one_clock_have_no_delay(seed):
    for test in (spectra(np.zeros(5), seed), record(np.zeros(5), seed)):
        clock = Clock.of(test)
        assert not clock.delays
        assert clock.test is test
    assert not np.any(delays_of(whole_fit(test, np.zeros(5))).values)


def test_records_without_any_structure_have_no_delay():
    rng = np.random.default_rng(6)
    base, response = (rng.normal(size=(2, n, 40)) + 1j * rng.normal(size=(2, n, 40)) for n in (1, 3))
    assert not Clock.of(sysid.Measurement(np.linspace(1, 12, 40), base, response, rigid_body=np.ones((3, 1)))).delays


def test_a_channel_that_never_moves_is_left_alone():
    test = spectra(LATE[0])
    response, std = test.response.copy(), test.response_std.copy()
    response[:, 3] = 0.0
    found = Clock.of(replace(test, response=response, response_std=std)).delays
    np.testing.assert_array_equal(np.flatnonzero(found.values), [1])


@pytest.mark.parametrize("complex_residues", [False, True])
@pytest.mark.parametrize("whole", [False, True])
def test_descent_is_the_slope_of_what_is_left_with_residues_free(whole, complex_residues):
    test = record(LATE[0]) if whole else spectra(LATE[0])
    beside = beside_poles(test)
    still, clocks, delays = _joined(beside.test), _clocks(test), 1e-4 * np.arange(5.0)
    at = _Late(still, clocks, delays, beside.at.poles, complex_residues)
    m, h = beside.at.poles.size, 1e-6

    def left(poles, delays):
        return np.sum((_Late(still, clocks, delays, poles, complex_residues).left / at.level) ** 2) / 2

    for k in range(5):
        step = h * np.eye(5)[k]
        slope = (left(at.poles, delays + step) - left(at.poles, delays - step)) / (2 * h)
        assert at.equations[1][m + k] == pytest.approx(-slope, rel=1e-4, abs=1e-6 * np.abs(at.equations[1][m:]).max())


def test_a_mode_that_the_poles_lack_is_found_before_delays_stand_for_it():
    test, truth = spectra([0.0] * 5), SETTING.structure
    omega = 2 * np.pi * truth.natural_frequencies
    lacking = np.delete(np.log([omega, truth.damping_ratios]), 1, axis=1).ravel()
    full = _with_further_poles(_Late(_joined(test), _clocks(test), np.zeros(5), lacking))
    assert np.sort(full.omega) == pytest.approx(omega, rel=1e-3)
    assert full.promise() < 30.0  # five squares of chance


def test_a_step_turns_no_line_by_more_than_a_quarter_of_a_period():
    """A step along what hardly shows is of any length; what turned records hold at their ends would fill the memory."""
    test = record(LATE[0])
    beside = beside_poles(test)
    at = _Late(_joined(beside.test), _clocks(test), np.zeros(5), beside.at.poles)
    asked = np.array([6e3, -2.0, 1e-4, 0.0, -1e-4])
    turned = at.moved(np.zeros(at.poles.size), asked).delays * test.freq[-1]
    np.testing.assert_allclose(turned, [0.25, -0.25, *asked[2:] * test.freq[-1]])


def test_one_delay_of_all_is_that_of_the_base_and_few_are_those_of_these():
    covariance = 1e-10 * (np.eye(4) + 0.2)
    alike = delays_beyond_chance(np.full(4, 5e-4), covariance, 0.0)
    assert alike is not None
    assert alike.of_base
    np.testing.assert_allclose(alike.values, 5e-4)
    np.testing.assert_allclose(alike.std, np.sqrt(1e-10 * (1 / 4 + 0.2)))
    one = delays_beyond_chance(np.array([1e-5, 5e-4, -1e-5, 0.0]), covariance, 0.0)
    assert one is not None
    np.testing.assert_array_equal(np.flatnonzero(one.values), [1])
    # Of the delay with the others held: regression on their errors.
    others = [0, 2, 3]
    carried = covariance[1, others] @ np.linalg.inv(covariance[np.ix_(others, others)])
    assert one.values[1] == pytest.approx(5e-4 - carried @ [1e-5, -1e-5, 0.0])
    assert one.std[1] == pytest.approx(np.sqrt(covariance[1, 1] - carried @ covariance[others, 1]))
    assert delays_beyond_chance(np.full(4, 1e-6), covariance, 0.0) is None
    assert delays_beyond_chance(np.full(4, 5e-4), covariance, 1e-3) is None


@pytest.mark.parametrize("of_records", [False, True])
def test_an_answer_tells_them_first_denies_nothing_and_is_stored_to_the_bit(of_records, tmp_path):
    test = record(LATE[0]) if of_records else spectra(LATE[0])
    result = sysid.identify(sysid.Problem(test), rng=0)
    first = result.findings[0]
    assert (first.kind, str(first.severity), first.channel) == ("late sensor", "note", "sensor 2")
    assert abs(first.numbers["delay"] - 2 * MS) < 4 * first.numbers["std"]
    assert result.determined
    n = SETTING.structure.n
    error = result.structure.mass[:n, :n] - SETTING.structure.mass[:n, :n]
    assert np.all(np.abs(error) < 4.5 * result.uncertainty.mass[:n, :n])
    result.save(tmp_path / "result.h5")
    again = sysid.load(tmp_path / "result.h5")
    np.testing.assert_array_equal(again.modal[0].delays.values, result.modal[0].delays.values)
    np.testing.assert_array_equal(again.modal[0].delays.std, result.modal[0].delays.std)
    np.testing.assert_array_equal(again.measurement.response, result.measurement.response)
    assert again.findings == result.findings


def test_stored_delays_of_another_test_are_refused():
    tree = vars(Delays.none(spectra(np.zeros(5))))
    with pytest.raises(sysid.InputError):
        Delays.from_tree({**tree, "values": np.zeros(3)}, spectra(np.zeros(5)))
    with pytest.raises(sysid.InputError):
        Delays.from_tree({**tree, "std": np.full(5, np.nan)}, spectra(np.zeros(5)))


def test_find_delays_without_poles_finds_none():
    assert not find_delays(spectra(LATE[0]), None)


@pytest.mark.parametrize(("loss", "seed"), [(10.0, 1), (5.0, 1), (5.0, 3)])
def test_dampers_of_a_small_structure_are_no_delays(loss, seed):
    """Two masses on equal dampers: complex residues of two modes cost little more than three delays."""
    K = np.array([[6500.0, -2500, -4000], [-2500, 2500, 0], [-4000, 0, 4000]])
    structure = sysid.Structure(np.diag([3.0, 2.0, 0.0]), K, n_base=1, damping_matrix=loss * np.eye(2))
    test = sysid.simulate(structure, np.linspace(1, 12, 150), noise=0.02, force=True, rng=seed)
    assert not Clock.of(test).delays


def test_a_mode_close_above_the_lines_makes_no_channel_late():
    """Complex residues of poles in the lines stand for it, real ones beside terms without poles do not."""
    clean = draw(continuous(0), 2).measurement
    assert not find_delays(clean, beside_poles(clean))


@pytest.mark.parametrize(("structure", "number"), [(cut, 1), (cut, 12), (continuous, 42)])
def test_modes_that_poles_miss_at_first_make_no_channel_late(structure, number):
    """Modes below the lines, and weak ones of fourteen: complex residues find them, real ones and delays did not."""
    assert not Clock.of(draw(structure(number)).measurement).delays


@pytest.mark.parametrize("periods", [0.05, 0.2, 0.249, 0.26, 0.9, 1.5])
def test_traces_of_turned_records_hold_what_is_not_theirs_however_small_the_delay(periods):
    """Sines at any frequencies, late and turned about, less the same on time; `periods` of half the last one."""
    rng, rate, n, last = np.random.default_rng(0), 500.0, 3000, 40.0
    frequencies, phases = rng.uniform(0.5, last, 80)[:, None], rng.uniform(0, 2 * np.pi, 80)[:, None]
    record = lambda t: np.sin(2 * np.pi * frequencies * t + phases).sum(axis=0)  # noqa: E731
    t, delay, freq = np.arange(n) / rate, periods / (2 * last), np.fft.rfftfreq(n, 1 / rate)
    late, due = np.fft.rfft(record(t - delay)), np.fft.rfft(record(t))
    lines = (freq > 0.5) & (freq <= last)
    left = (late * np.exp(2j * np.pi * freq * delay) - due)[lines]
    traces = WholeRecords((n,), rate, (False,)).earlier(np.array([delay])).traces(freq[lines], last)
    A, b = np.hstack([traces.real, traces.imag]).T, np.hstack([left.real, left.imag])
    A /= np.linalg.norm(A, axis=0)
    assert np.linalg.cond(A) < 1e6
    assert np.linalg.norm(b - A @ np.linalg.lstsq(A, b)[0]) < 0.005 * np.linalg.norm(b)
