"""Gains within stated tolerances: what is taken off, what intervals hold, and who is named beyond them."""

import dataclasses
from statistics import NormalDist

import numpy as np
import pytest

import sysid
from sysid import Problem, Sensor, Structure, simulate
from sysid.assessment.checks.gains import GainErrors
from sysid.assessment.uncertainty import moves_by_records
from sysid.errors import InputError
from sysid.jobs.changes import drawn_from
from sysid.measurement.channels import read_by_gains, seen_at_sensors, without_delays, without_gains
from sysid.modal_analysis.calibration import Calibration
from sysid.modal_analysis.delays import find_delays
from sysid.modal_analysis.first_modes import first_modes
from sysid.modal_analysis.fit import _beside_free_gains, _without_errors, fit_modes, whole_fit
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.model_order import Peak, with_peak
from sysid.modal_analysis.record_fit import on_turned
from sysid.modal_analysis.record_model import RecordModel
from sysid.modal_analysis.residual_tests import calibration_of

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
ERROR = 0.02
TOLERANCES = {"gain_std": 0.005, "base_gain_std": 0.004, "force_gain_std": 0.003}


def misread(test, errors):
    """The test as channels with these errors of their gains record it."""
    return dataclasses.replace(without_gains(test, 1 / (1 + errors) - 1), gain_std=None, base_gain_std=None,
                               force_gain_std=None)  # fmt: skip


def frame(sensors=None):
    """Four storeys on a base of 2 kg, and modes some widths apart."""
    K = 5000.0 * np.array([[2.0, -1, 0, 0, -1], [-1, 2, -1, 0, 0], [0, -1, 2, -1, 0], [0, 0, -1, 1, 0],
                           [-1, 0, 0, 0, 1]])  # fmt: skip
    return Structure(np.diag([4.0, 3.0, 5.0, 2.0, 2.0]), K, [0.01, 0.015, 0.02, 0.015], n_base=1, sensors=sensors)


@pytest.fixture(scope="module")
def spectra():
    f = frame().natural_frequencies
    return simulate(frame(), np.geomspace(0.3 * f[0], 1.4 * f[-1], 300), noise=0.003, force=True, rng=3)


@pytest.fixture(scope="module")
def records(spectra):
    """A run of the frame under sums of cosines that are no lines of the records."""
    rng, rate, truth = np.random.default_rng(0), 40.0, frame()
    freq = np.linspace(0.9, 13.0, 173)
    H = np.concatenate([np.ones((1, freq.size)), truth.transmissibility(freq)[:, 0], truth.base_force(freq)[0]])
    runs = []
    for _ in range(1):
        waves = rng.normal(size=freq.size) + 1j * rng.normal(size=freq.size)
        clean = ((H * waves) @ np.exp(2j * np.pi * np.outer(freq, np.arange(1600) / rate))).real
        noisy = clean + 0.01 * np.std(clean, axis=1)[:, None] * rng.normal(size=clean.shape)
        runs.append((noisy[:1], noisy[1:-1], noisy[-1:]))
    return sysid.Measurement.from_time(runs, rate, rigid_body=truth.rigid_body, band=(0.9, 13.0))


@pytest.fixture(scope="module")
def plain(spectra, records):
    """What is identified from each where gains are exact."""
    return {"spectra": sysid.identify(Problem(spectra), rng=0), "records": sysid.identify(Problem(records), rng=0)}


@pytest.mark.parametrize(
    ("kind", "gain"), [("spectra", 1), ("spectra", 4), ("spectra", 5), ("records", 1), ("records", 4)]
)  # of a sensor, the base, the force
def test_moves_are_those_of_refits(spectra, records, kind, gain, plain):
    test, step = {"spectra": spectra, "records": records}[kind], 1e-3
    result = plain[kind]
    modes, index, *_, shifts, _ = moves_by_records(result.prepared, result.structure, gains=True)
    ends = [sysid.identify(Problem(misread(test, sign * step * np.eye(6)[gain])), rng=0).structure for sign in (1, -1)]
    phi, gamma, _, _, rigid = index.split(shifts[:, [gain]])
    signs = [np.sign(np.sum(one.participation * modes.gamma, axis=1)) for one in ends]
    for moved, parts in (
        (phi[..., 0], [one.mode_shapes * sign for one, sign in zip(ends, signs, strict=True)]),
        (gamma[..., 0], [one.participation * sign[:, None] for one, sign in zip(ends, signs, strict=True)]),
        (rigid[..., 0], [one.rigid_body_mass for one in ends]),
    ):
        change = (parts[0] - parts[1]) / (2 * step)
        np.testing.assert_allclose(moved, change, rtol=0.02, atol=0.01 * np.abs(change).max() + 1e-3)


def test_slopes_of_the_model_of_records_by_gains(records):
    """Central differences of fourth order of its sum of squares."""
    test, rng = dataclasses.replace(records, **TOLERANCES), np.random.default_rng(1)
    fit = whole_fit(records)
    model = RecordModel(test, fit.model.m)
    x = model.pack(dataclasses.replace(fit.parameters, gains=rng.normal(size=6)))
    slopes = model.normal_equations(model.unpack(x), fit.levels).gradient
    for at in [*range(model.of_gains.start, model.of_gains.stop), int(model.index.rigid[0]), model.index.gamma.start]:
        step = 1e-4 * max(abs(x[at]), 0.1) * np.eye(x.size)[at]
        values = [model.chi2(model.unpack(x + times * step), fit.levels) for times in (-2, -1, 1, 2)]
        slope = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step[at])
        assert slope == pytest.approx(-2 * slopes[at], rel=1e-5, abs=1e-6 * np.abs(slopes).max())


def test_modes_fit_as_well_once_errors_of_gains_are_taken_off_both(records):
    """Of modes as recorded there would be left what the errors are, far more than the noise where that is small."""
    test = dataclasses.replace(misread(records, 0.005 * np.array([1, -1, 1, 0, -1, 1])), **TOLERANCES)
    fit = whole_fit(test)
    p, errors = fit.parameters, fit.parameters.gains * Calibration.stated(test).tolerance
    assert np.count_nonzero(np.abs(errors) > 0.002) > 3
    free = without_gains(test, errors)
    chi2 = lambda p: fit.model_of(p, free).chi2(p, fit.levels)  # noqa: E731
    none = dataclasses.replace(p, gains=np.zeros(0))
    at_end = fit.chi2 - p.gains @ p.gains / 2
    assert abs(chi2(_without_errors(none, errors)) - at_end) < 0.01 * at_end
    assert chi2(none) - at_end > 0.03 * at_end


def test_likeliest_errors_of_gains_are_those_of_least_squares(spectra):
    test = dataclasses.replace(spectra, **TOLERANCES)
    stated, rng = Calibration.stated(test), np.random.default_rng(2)
    error, std = 0.003 * rng.normal(size=4), np.array([0.001, 0.004, 0.02, 0.001])
    found = stated.given(test, np.where(np.arange(4) == 2, np.nan, error), std)
    known = np.arange(4) != 2
    rows = np.vstack([seen_at_sensors(test)[known] / std[known, None], np.diag(1 / stated.tolerance)])
    wanted = np.concatenate([error[known] / std[known], np.zeros(6)])
    np.testing.assert_allclose(found.values, np.linalg.lstsq(rows, wanted)[0], atol=1e-12)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(rows.T @ rows), atol=1e-14)


def test_records_show_gains_as_closely_as_the_estimate_beside_exact_ones(records):
    """Where tolerances are wide they tell next to nothing: what is found is what the records show."""
    errors = np.array([0.012, -0.02, 0.007, 0.0, 0.0, 0.0])
    given = dataclasses.replace(misread(records, errors), gain_std=0.25)
    fit = whole_fit(given)
    found = calibration_of(fit, Calibration.stated(given))
    std = np.sqrt(np.diag(found.covariance))[:4]
    assert np.all(np.abs(found.values - errors)[:4] < 4 * std) and np.all(std < 0.004) and np.all(std > 1e-4)


@pytest.mark.parametrize("kind", ["spectra", "records"])
def test_intervals_hold_tolerances_and_nobody_is_accused(spectra, records, kind, plain):
    test = {"spectra": spectra, "records": records}[kind]
    errors = np.array([0.006, -0.004, 0.003, -0.007, 0.004, -0.003])
    result = sysid.identify(Problem(dataclasses.replace(misread(test, errors), **TOLERANCES)), rng=0)
    assert result.determined and "gain" not in [one.kind for one in result.findings]
    truth = frame()
    for name, exact in (("mass", truth.mass[:4, :4]), ("stiffness", truth.stiffness[:4, :4])):
        std = getattr(result.uncertainty, name)
        assert np.all(np.abs(getattr(result.structure, name)[:4, :4] - exact) < 4 * std)
        # Of the force no record shows the gain, and M, K and C are in proportion to it.
        least = np.hypot(np.diag(getattr(plain[kind].uncertainty, name)), 0.003 * np.diag(exact))
        assert np.all(np.diag(std) > 0.98 * least)
    taken = result.modal[0].calibration
    sensors = seen_at_sensors(test) @ taken.values
    np.testing.assert_allclose(sensors, seen_at_sensors(test) @ errors, atol=0.003)


def test_gains_beyond_tolerances_are_named(spectra):
    errors = np.array([0.003, 0.05, -0.004, 0.002, 0.003, 0.0])
    result = sysid.identify(Problem(dataclasses.replace(misread(spectra, errors), **TOLERANCES)), rng=0)
    (told,) = result.contradictions
    assert told.channel == "sensor 2" and told.kind in ("gain", "rigid motion")
    assert result.gains.error[1] == pytest.approx(0.05, abs=0.01)
    # It tells nothing of the others, of which what is likely was taken off.
    assert np.all(np.abs(result.modal[0].calibration.values) < 0.009) and result.modal[0].calibration.values[1] == 0


@pytest.mark.parametrize("kind", ["spectra", "records"])
def test_a_sensor_of_the_other_sign_tells_nothing_of_the_others(spectra, records, kind):
    test = {"spectra": spectra, "records": records}[kind]
    wrong = dataclasses.replace(misread(test, -2.0 * np.eye(6)[2]), **TOLERANCES)
    result = sysid.identify(Problem(wrong), rng=0)
    assert np.all(np.abs(result.modal[0].calibration.values) < 0.006)
    assert [one.channel for one in result.contradictions if one.channel] == ["sensor 3"]


def test_a_written_model_finds_errors_of_gains_in_a_few_rounds():
    """Its poles hold what wrong gains do to it, so that one round leaves some of them."""
    K = np.array([[8000.0, -4000, 0], [-4000, 7000, -3000], [0, -3000, 3000]])
    whole = np.block([[K, -K.sum(axis=1)[:, None]], [-K.sum(axis=1)[None], np.array([[K.sum()]])]])
    truth = Structure(np.diag([5.0, 4.0, 3.0, 0.0]), whole, [0.01, 0.01, 0.01], n_base=1)
    test = simulate(truth, np.linspace(1.0, 9.0, 300), noise=1e-3, rng=2)
    errors = np.array([0.01, -0.01, 0.012, 0.0, 0.0])
    springs = sysid.ChainStiffness(1e3, 1e4)
    given = dataclasses.replace(misread(test, errors), gain_std=0.01)
    result = sysid.identify(Problem(given, mass=sysid.LumpedMass(12.0), stiffness=springs), rng=0)
    assert result.residual < 1.5e-3 and not result.contradictions
    np.testing.assert_allclose(result.modal[0].calibration.values[:3], errors[:3], atol=0.003)


def test_draws_hold_errors_of_gains(spectra):
    """The scatter of a force's gain is that of M, which no record shows otherwise."""
    given = dataclasses.replace(spectra, force_gain_std=0.05)
    result = sysid.identify(Problem(given), rng=0)
    found = [
        sysid.identify(drawn_from(result, np.random.SeedSequence(seed)), rng=0).structure.mass[0, 0]
        for seed in range(10)
    ]
    assert 0.5 < np.std(found) / (0.05 * 4.0) < 1.6


def test_one_error_of_all_sensors_is_the_bases(spectra):
    result = sysid.identify(Problem(misread(spectra, ERROR * np.eye(6)[4])), rng=0)
    (told,) = [one for one in result.findings if one.kind == "gain"]
    assert told.channel == "base x" and told.numbers["gain"] == pytest.approx(1 + ERROR, abs=2e-3)


def test_one_wrong_sensor_is_no_table_that_rocks():
    """Nor one of the base, whichever is known best."""
    sensors = [Sensor(f"floor {i}", (0.0, 0.0, z), "x") for i, z in enumerate((0.0, 0.0, 0.0, 3.0), start=1)]
    truth = frame(sensors)
    f = truth.natural_frequencies
    test = simulate(truth, np.geomspace(0.3 * f[0], 1.4 * f[-1], 300), noise=0.001, rng=4, base_axes="x")
    found = sysid.identify(Problem(misread(test, np.array([0, 0, 0, ERROR, 0, 0]))), rng=0).findings
    assert [one.channel for one in found if one.kind in ("gain", "table rocks")] == ["floor 4"]
    errors = GainErrors(np.array([0.05, 0.002, -0.001]), np.array([0.002, 0.03, 0.03]), np.zeros(3), 500, np.zeros(3))
    assert errors.of_base() is None and errors.wrong.tolist() == [0]


def test_a_result_with_tolerances_is_stored_to_the_bit(records, tmp_path):
    given = dataclasses.replace(misread(records, 0.004 * np.ones(6)), **TOLERANCES)
    result = sysid.identify(Problem(given), rng=0)
    result.save(tmp_path / "result.h5")
    again = sysid.load(tmp_path / "result.h5")
    for one, other in zip(vars(result.modal[0].calibration).values(), vars(again.modal[0].calibration).values(),
                          strict=True):  # fmt: skip
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(result.uncertainty.mass, again.uncertainty.mass)
    assert again.measurement.response.tobytes() == result.measurement.response.tobytes()


def test_functions_for_unit_motion_stay_so(spectra):
    errors = 0.01 * np.arange(1, 7)
    assert without_gains(spectra, errors).has_unit_runs
    moved = dataclasses.replace(spectra, base=spectra.base * (1 + 1e-9j))  # no unit runs any more
    plain, unit = without_gains(moved, errors), without_gains(spectra, errors)
    np.testing.assert_allclose(unit.response, plain.response / (plain.base / moved.base), rtol=1e-8)
    np.testing.assert_allclose(unit.force, plain.force / (plain.base / moved.base), rtol=1e-8)


def test_late_channels_are_found_beside_tolerances(spectra, monkeypatch):
    monkeypatch.setattr("sysid.modal_analysis.delays.find_delays", find_delays)
    late = without_delays(spectra, -np.array([0.0, 0.002, 0.0, 0.0, 0.0]))
    errors = np.array([0.004, -0.003, 0.006, 0.0, 0.002, 0.0])
    result = sysid.identify(Problem(dataclasses.replace(misread(late, errors), **TOLERANCES)), rng=0)
    assert result.determined and result.findings[0].kind == "late sensor" and result.findings[0].channel == "sensor 2"


def test_what_gains_make_of_channels(records):
    """Against records divided by one and small errors, of a model whose participations take up the base's."""
    test = dataclasses.replace(records, **TOLERANCES)
    moves = read_by_gains(test)
    assert moves.shape == (5, 1, 6)
    np.testing.assert_allclose(moves[1, 0], [0, 0.005, 0, 0, -0.004, 0])
    np.testing.assert_allclose(moves[4, 0], [0, 0, 0, 0, 0.004, 0.003])
    assert read_by_gains(dataclasses.replace(test, force=None)).shape == (4, 1, 5)


@pytest.mark.parametrize("std", [-0.1, 0.5, np.nan, [0.1, 0.1]])
def test_what_is_no_tolerance_is_refused(spectra, std):
    with pytest.raises(sysid.InputError, match="gain_std"):
        dataclasses.replace(spectra, gain_std=std)


def test_a_mode_that_stood_for_errors_of_gains_goes_with_them(records, monkeypatch):
    """What was worth a mode before, as a second one within the width of another, is none beside the gains."""
    read = dataclasses.replace(misread(records, np.r_[0.005 * np.array([1, -1, 1, 2]), 0.0, 0.0]), **TOLERANCES)
    fit = whole_fit(read)
    modes, inputs = fit.parameters.modes, fit.model.d + 2 * len(fit.model.moving)
    slow = Peak(
        0.8 * modes.omega[0],
        0.9,
        1e-3 * np.r_[modes.phi[:, 0], modes.gamma[0]],
        np.r_[modes.gamma[0], np.zeros(inputs - 1)],
    )
    more = dataclasses.replace(fit, parameters=with_peak(fit, fit.parameters, slow))
    monkeypatch.setattr("sysid.modal_analysis.fit.whole_fit", lambda *_, **__: on_turned(more, fit.test))
    found = fit_modes(read)
    assert np.any(found.calibration.values)
    assert np.allclose(found.modes.omega, modes.omega, rtol=1e-4)


@pytest.mark.parametrize("tolerance", [0.0, 0.007])
def test_a_gain_is_beyond_a_stated_tolerance_at_a_chance_of_one_in_a_hundred_tests(tolerance):
    std = 0.0005 if tolerance else 0.007
    total = np.hypot(std, tolerance)
    for chance in (3e-2, 3e-3, 3e-4):  # of one of eight sensors so far off, either way
        off = NormalDist().inv_cdf(1 - chance / 16) * total
        errors = GainErrors(np.r_[off, np.zeros(7)], np.full(8, std), np.zeros(8), 10**6, np.full(8, tolerance))
        assert list(errors.wrong) == ([0] if chance < (1e-2 if tolerance else 1e-3) else [])


@pytest.mark.parametrize("wrong, channel", [(0, "sensor 1"), (4, "base x")], ids=["a sensor", "the base"])
def test_poles_that_stand_for_a_wrong_gain_are_not_in_the_answer(records, plain, wrong, channel, tmp_path):
    """The gain is told, and the modes are those of right records, of shapes as recorded."""
    result = sysid.identify(Problem(misread(records, ERROR * np.eye(6)[wrong])), rng=0)
    assert [(one.kind, one.channel) for one in result.contradictions] == [("gain", channel)]
    constants, right = result.modal[0].record_fit.constants, plain["records"]
    driven = np.arange(4) == wrong if wrong < 4 else np.full(4, True)
    size = ERROR if wrong < 4 else 1 / (1 + ERROR) - 1
    np.testing.assert_allclose(constants[driven], size * records.rigid_body[driven], atol=0.2 * ERROR)
    assert not np.any(constants[~driven])
    ratio = np.mean(result.modal[0].as_recorded.response / right.modal[0].records.response, axis=(0, 2))
    np.testing.assert_allclose(ratio, 1 + ERROR * (np.arange(4) == wrong), atol=0.1 * ERROR)
    np.testing.assert_allclose(
        result.structure.natural_frequencies, right.structure.natural_frequencies, rtol=2e-5
    )  # fmt: skip
    factor = (1 + ERROR * driven if wrong < 4 else np.full(4, (1 + ERROR) ** -0.5))[:, None]
    np.testing.assert_allclose(
        np.abs(result.structure.mode_shapes), np.abs(factor * right.structure.mode_shapes), atol=0.003
    )
    result.save(tmp_path / "result.h5")
    again = sysid.load(tmp_path / "result.h5")
    np.testing.assert_array_equal(again.gains.error, result.gains.error)
    np.testing.assert_array_equal(again.modal[0].records.response, result.modal[0].records.response)


def other_axis(test, sensor):
    """The test where the axis of a sensor is stated across the base's motion, while it is along it."""
    return dataclasses.replace(test, rigid_body=test.rigid_body * (np.arange(4) != sensor)[:, None])


@pytest.mark.parametrize("mistake", ["sign", "axis"])
def test_what_a_wrong_sign_or_axis_adds_is_no_mode(records, plain, mistake, tmp_path):
    """It is taken off beside the first modes: the others are as of right records, and the sensor is told."""
    wrong = misread(records, -2.0 * np.eye(6)[2]) if mistake == "sign" else other_axis(records, 2)
    first = first_modes(wrong, np.zeros(5), FitMonitor())[1]
    adds = (-2.0 if mistake == "sign" else 1.0) * np.outer(np.arange(4) == 2, records.rigid_body[2])
    np.testing.assert_allclose(first.constants, adds, rtol=1e-12)
    result, right = sysid.identify(Problem(wrong), rng=0), plain["records"]
    assert {one.channel for one in result.contradictions} == {"sensor 3"} and not result.structure.residual.count
    np.testing.assert_array_equal(result.modal[0].record_fit.constants, first.constants)
    np.testing.assert_allclose(result.structure.natural_frequencies, right.structure.natural_frequencies, rtol=1e-4)
    np.testing.assert_allclose(
        np.abs(result.structure.mode_shapes), np.abs(right.structure.mode_shapes), atol=0.01
    )  # fmt: skip
    result.save(tmp_path / "result.h5")
    again = sysid.load(tmp_path / "result.h5")
    np.testing.assert_array_equal(again.modal[0].record_fit.constants, first.constants)
    np.testing.assert_array_equal(again.modal[0].records.response, result.modal[0].records.response)
    assert [str(one) for one in again.contradictions] == [str(one) for one in result.contradictions]


def test_two_wrong_sensors_are_taken_off_one_by_one(records):
    wrong = other_axis(misread(records, -2.0 * np.eye(6)[0]), 3)
    first = first_modes(wrong, np.zeros(5), FitMonitor())[1]
    np.testing.assert_allclose(first.constants[:, 0], [-2.0, 0.0, 0.0, 1.0], rtol=1e-12)


@pytest.mark.parametrize("size", [-0.3, -0.05, 0.05, 0.3])
def test_wrong_gains_are_left_to_the_fit_of_all_modes(records, size):
    first = first_modes(misread(records, size * np.eye(6)[1]), np.zeros(5), FitMonitor())[1]
    assert not np.any(first.constants)


def test_right_gains_and_modes_below_the_lines_take_no_constants_off(records):
    """Beside a mode below the lines gains are not judged, and what was taken off would not be told."""
    f = np.sort(frame().natural_frequencies)
    above = records.at(records.freq > (f[0] + f[1]) / 2)
    for test in (records, above, misread(above, ERROR * np.eye(6)[2])):
        fit = whole_fit(test)
        assert not (np.any(fit.constants) and np.any(fit.parameters.modes.omega < 2 * np.pi * test.freq[0]))
    assert not np.any(whole_fit(above).constants)


def test_what_ends_the_search_beside_free_gains_or_is_not_likelier_keeps_the_fit_at_hand(records, monkeypatch):
    """Of free gains that are not likelier nothing is fitted again."""
    fit = whole_fit(misread(records, ERROR * np.eye(6)[0]))
    wrong = dataclasses.replace(fit, test=misread(records, ERROR * np.eye(6)[0]))

    def ended(error):
        def anew(*_):
            raise error

        monkeypatch.setattr("sysid.modal_analysis.fit._whole_fit", anew)
        return _beside_free_gains(wrong, FitMonitor())

    assert np.any(fit.constants) and ended(InputError("no mode stands out")) is wrong
    stopped = ended(KeyboardInterrupt())
    assert stopped.stopped and stopped.test is wrong.test and stopped.parameters is wrong.parameters
    given = dataclasses.replace(wrong.test, gain_std=np.full(fit.model.n, 0.05))
    p = dataclasses.replace(wrong.parameters, gains=np.zeros(fit.model.n))
    free = dataclasses.replace(wrong, chi2=2 * wrong.chi2, test=given, parameters=p)
    monkeypatch.setattr("sysid.modal_analysis.fit._whole_fit", lambda *_: free)
    monkeypatch.setattr("sysid.modal_analysis.fit.refitted", lambda *_, **__: pytest.fail("fitted again"))
    assert _beside_free_gains(wrong, FitMonitor()) is wrong
