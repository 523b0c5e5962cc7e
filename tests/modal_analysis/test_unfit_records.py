"""Whole records that no modes explain: least squares take the place of noise, which quiet lines bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sysid
from benchmarks.channels.unfit import Case
from benchmarks.records.simulated import four_storeys, with_noise
from sysid.modal_analysis.fit import whole_fit
from sysid.modal_analysis.misfit import left_of
from sysid.modal_analysis.noise_levels import bounded_by_lines
from sysid.modal_analysis.record_fit import RecordFit, record_modes
from sysid.modal_analysis.record_model import RecordModel
from sysid.modal_analysis.rough_poles import at_few_lines

LOADED = 5  # a bridge under vehicles: noise of the base explained twice a rigid body's residual


@pytest.fixture(scope="module")
def loaded() -> sysid.Identification:
    return Case.of(LOADED).identified()


def test_a_load_that_nobody_recorded_leaves_no_more_than_spectra_and_a_rigid_body(
    loaded: sysid.Identification,
) -> None:
    modes = loaded.structure.natural_frequencies.size
    spectra = Case.of(LOADED).identified("spectra", sysid.Modal(modes=modes))
    assert loaded.residual < min(1.0, 1.01 * spectra.residual)
    assert loaded.judgement == "no fit"
    told = loaded.of_kind("least squares")[0]
    assert told.numbers["residual"] == loaded.residual


def test_noise_is_at_most_what_the_quietest_lines_hold(loaded: sysid.Identification) -> None:
    """The mean of 16 squares of white noise is below 0.70 in a tenth of all cases; a tenth of a level is chance."""
    fit, test = loaded.modal[0].record_fit, Case.of(LOADED).test()
    assert fit is not None and loaded.noise is not None
    density = fit.model.whole.density[0]
    for level, record in ((loaded.noise.response, test.response[0]), (loaded.noise.base, test.base[0])):
        blocks = np.sort(np.mean(np.abs(record[:, : record.shape[1] // 16 * 16].reshape(len(record), -1, 16)) ** 2, 2))
        assert np.all(0.70 * (level / 1.1) ** 2 * density < blocks[:, blocks.shape[1] // 10 + 1])
    assert np.all(np.sqrt(fit.levels[0, : test.n_sensors]) > loaded.noise.response)  # which is what squares leave


def test_least_squares_are_least(loaded: sysid.Identification) -> None:
    """Squares of the relative accelerations rise where any mode moves, by differences of the second order."""
    fit = loaded.modal[0].record_fit
    assert fit is not None and fit.model.whole.plain
    least, p, rng = left_of(fit), fit.parameters, np.random.default_rng(0)
    for _ in range(10):
        change = [1 + 1e-3 * rng.standard_normal(part.shape) for part in p.modes]
        moved = type(p.modes)(*(part * by for part, by in zip(p.modes, change, strict=True)))
        assert left_of(replace(fit, parameters=replace(p, modes=moved))) > least * (1 - 1e-7)


def test_poles_looked_for_anew_leave_as_little_as_spectra() -> None:
    """A chain on two supports: from the modes that noise in all channels made, squares end at .505."""
    case = Case.of(22)
    fit = whole_fit(case.test())
    modes = int(np.count_nonzero(fit.parameters.modes.omega >= 2 * np.pi * fit.test.freq[0]))
    spectra = sysid.identify(sysid.Problem(case.test("spectra")), strategy=sysid.Modal(modes=modes), rng=0)
    assert fit.model.whole.plain
    assert left_of(fit) < 1.01 * spectra.residual < 0.5


def test_a_stored_fit_stays_one_of_least_squares(loaded: sysid.Identification) -> None:
    fit, case = loaded.modal[0].record_fit, Case.of(LOADED)
    assert fit is not None
    read = RecordFit.from_tree(fit.to_tree(), case.test())
    assert read.model.whole.plain
    assert np.array_equal(read.noise.response, fit.noise.response)
    before = {key: value for key, value in fit.to_tree().items() if key != "plain"}  # as results of before are
    assert not RecordFit.from_tree(before, case.test()).model.whole.plain


def sound(at_rest: bool = False) -> sysid.Measurement:
    setting = four_storeys()
    rng = np.random.default_rng(2)
    records, _ = setting.with_noise(setting.run(rng, 20.0).records(), rng)
    return sysid.Measurement.from_time(
        [(records.base, records.response, records.force)], setting.sample_rate, rigid_body=np.ones((4, 1)),
        band=setting.lines, at_rest=at_rest,
    )  # fmt: skip


def test_sound_records_keep_the_noise_of_all_channels() -> None:
    fit = whole_fit(sound())
    assert not fit.model.whole.plain
    assert np.array_equal(fit.noise.base, np.sqrt(fit.levels[0, -1:]))


def test_runs_that_were_not_at_rest_are_a_mistake_of_its_own() -> None:
    assert not whole_fit(sound(at_rest=True)).model.whole.plain


@pytest.mark.parametrize(("sine", "few"), [(0.0, False), (1.0, False), (2.0, True)])
def test_a_base_moves_at_few_lines_where_a_sine_holds_most_of_its_power(sine: float, few: bool) -> None:
    """Beside random motion of 1 m/s² rms, a sine whose power is a half of its squared amplitude."""
    rng, t = np.random.default_rng(7), np.arange(4000) / 50.0
    base = rng.standard_normal((1, t.size)) + sine * np.sin(2 * np.pi * 3.01 * t)
    test = sysid.Measurement.from_time([(base, base, None)], 50.0, rigid_body=[[1.0]], band=(0.1, 25.0))
    assert at_few_lines(test) == few


def test_levels_are_cut_where_they_are_above_white_noise_of_the_quietest_lines() -> None:
    """Noise alone: a level that is right stays, one that is ten times too large is cut to it."""
    rng, rate, n = np.random.default_rng(6), 100.0, 20000
    base, response = 0.3 * rng.standard_normal((1, n)), 2.0 * rng.standard_normal((2, n))
    test = sysid.Measurement.from_time([(base, response, None)], rate, rigid_body=np.ones((2, 1)))
    model = RecordModel(test, 1)
    right = np.array([[4.0, 4.0, 0.09]])
    assert np.array_equal(bounded_by_lines(model, right), right)
    assert bounded_by_lines(model, 100 * right) == pytest.approx(right, rel=0.1)


def test_levels_of_least_squares_are_the_mean_square_that_is_left() -> None:
    """One level of all sensors and one of the force, by the numbers left of those that the unknowns take."""
    test = sound()
    assert test.whole is not None
    plain = replace(test, whole=replace(test.whole, plain=True))
    fit = record_modes(plain, 2 * np.pi * np.array([2.7, 7.5, 10.5, 12.8]), np.full(4, 0.015))
    left = np.concatenate([np.abs(chunk.error) ** 2 for chunk in fit.model.chunks(fit.parameters)], axis=1)
    share = fit.model.numbers / fit.freedom / fit.model.whole.density[0]
    assert fit.levels[0, :4] == pytest.approx(np.full(4, share * left[:4].mean()), rel=1e-9)
    assert fit.levels[0, 4] == pytest.approx(share * left[4].mean(), rel=1e-9)
    assert fit.levels[0, 5] < 1e-8 * np.mean(np.abs(test.base) ** 2) / fit.model.whole.density[0]


def test_a_tone_in_noisy_records_is_no_wrong_model() -> None:
    """Least squares always miss a little less than a fit that knows the noise of the base, and are biased by it."""
    setting, rng = four_storeys(), np.random.default_rng(2)
    records, _ = with_noise(setting.run(rng, 60.0).records(), rng, 0.15)
    response, time = records.response.copy(), np.arange(records.response.shape[1]) / records.sample_rate
    response[1] += 0.3 * np.std(response[1]) * np.sin(2 * np.pi * 16.3 * time)
    fit = whole_fit(
        sysid.Measurement.from_time(
            [(records.base, response, records.force)], records.sample_rate, rigid_body=np.ones((4, 1)),
            band=setting.lines,
        )
    )  # fmt: skip
    assert left_of(fit) > 0.1 and not fit.model.whole.plain
