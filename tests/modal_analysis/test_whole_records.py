"""Modes found in whole records: cases in which the search once missed one, found one too many, or failed."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.fit import whole_fit
from sysid.modal_analysis.residual_tests import gain_errors_of
from sysid.modal_analysis.rough_poles import decimated_lines
from sysid.structure.structure import Structure

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def records():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        names = ("simulated", "trial", "two_runs")
        yield [importlib.import_module(f"benchmarks.records.{name}") for name in names]


def _coupled(records, seed, draw):
    simulated, trial, _ = records
    setting, rng = simulated.coupled(seed), np.random.default_rng((seed, draw, 5))
    noisy, levels = setting.with_noise(setting.run(rng).records(), rng)
    return setting.structure, levels, whole_fit(trial.measurement([noisy], setting, force=True))


def _assert_the_modes(fit, truth):
    modes = fit.parameters.modes
    assert modes.omega.size == truth.n
    assert np.all(np.abs(np.sort(modes.omega) / (2 * np.pi) / truth.natural_frequencies - 1) < truth.damping_ratios)


def test_few_lines_make_no_channel_exact(records):
    truth, levels, fit = _coupled(records, seed=33, draw=3)  # 22 lines, seven channels, four modes
    _assert_the_modes(fit, truth)
    true = np.concatenate([levels.response, levels.force, levels.base])
    assert np.all(np.sqrt(fit.levels[0]) > 0.1 * true)


def test_a_mode_that_is_worth_less_than_the_price_of_its_unknowns_is_found(records):
    truth, _, fit = _coupled(records, seed=12, draw=3)  # its sixth mode raises chi² by 57, its unknowns cost 53
    _assert_the_modes(fit, truth)


def test_two_poles_about_one_mode_are_left_for_those_of_the_second_search(records):
    simulated, trial, two_runs = records
    setting = simulated.four_storeys()
    fit = whole_fit(trial.measurement(two_runs._runs("two runs", 8)[1], setting, force=True))
    _assert_the_modes(fit, setting.structure)


def test_a_weak_mode_that_only_all_lines_of_a_long_record_show_is_found(records):
    simulated, trial, _ = records
    weak = np.array([1.0, 1.0, 3e-4])
    structure = simulated.coupled_structure(np.random.default_rng(1), 3, 1, np.array([2.0, 8.0, 30.0]), weak)
    setting = simulated.Setting(structure, 120.0, 200.0, (1.0, 40.0), (0.5, 60.0), np.eye(1))
    rng = np.random.default_rng(2)
    noisy, _ = setting.with_noise(setting.run(rng).records(), rng)
    test = trial.measurement([noisy], setting, force=True)
    assert whole_fit(test.at(decimated_lines(test))).parameters.modes.omega.size == 2
    _assert_the_modes(whole_fit(test), structure)


def test_modes_at_one_pole_are_as_many_as_its_residue_has_rank(records):
    simulated, trial, _ = records
    drawn = simulated.coupled_structure(np.random.default_rng(3), 4, 2, np.array([2.0, 5.0, 5.0, 9.0]))
    truth = Structure(drawn.mass, drawn.stiffness, np.array([0.01, 0.012, 0.012, 0.02]), n_base=2)
    setting = simulated.Setting(truth, 60.0, 50.0, (1.0, 15.0), (0.5, 20.0), np.eye(2))
    rng = np.random.default_rng(4)
    noisy, _ = setting.with_noise(setting.run(rng).records(), rng)
    _assert_the_modes(whole_fit(trial.measurement([noisy], setting, force=True)), truth)


@pytest.mark.parametrize(("seed", "draw"), [(19, 0), (33, 0)])
def test_a_pole_is_no_two_modes_where_one_explains_it(records, seed, draw):
    truth, _, fit = _coupled(records, seed, draw)  # the residue of one pole has rank two, from errors of all poles
    _assert_the_modes(fit, truth)


def test_a_second_pole_within_the_width_of_a_mode_is_left_where_the_second_search_has_one(records):
    simulated, trial, _ = records
    setting, rng = simulated.four_storeys(0.0), np.random.default_rng((3, 4))
    noisy, _ = setting.with_noise(setting.run(rng).records(), rng)
    _assert_the_modes(whole_fit(trial.measurement([noisy], setting, force=True)), setting.structure)


def test_records_without_noise_have_the_modes_of_the_structure(records):
    simulated, trial, _ = records
    setting, rng = simulated.four_storeys(), np.random.default_rng(1)
    run = setting.run(rng).records()  # what folds back of the transients shows at some 1e-6 of the records
    _assert_the_modes(whole_fit(trial.measurement([run], setting, force=True)), setting.structure)


@pytest.mark.parametrize("gain", [1.0, 1.2])
def test_motion_with_the_base_is_judged_beside_its_noise(records, gain):
    # Base directions nearly dependent: a hundredth of the base's power is noise, much more of its least direction.
    simulated, _, _ = records
    rng = np.random.default_rng(5)
    truth = simulated.coupled_structure(rng, 4, 3, np.array([2.1, 3.4, 5.2, 9.0]))
    mixing = np.array([[1.0, 0.3, 0.2], [0.3, 1.0, 0.1], [0.98, 0.35, 0.2]])
    size = np.linalg.norm(mixing, axis=1)
    motion = simulated.random_motion(rng, 40.0, 40.0, (0.5, 15.0), correlation=mixing @ mixing.T / np.outer(size, size))
    run = simulated.Run.ringing(simulated.Modes.of(truth), motion, rng)
    noisy, _ = simulated.with_noise(run.records(), rng, 0.01)
    response = noisy.response.copy()
    response[0] *= gain
    test = Measurement.from_time(
        [(noisy.base, response, noisy.force)], 40.0, rigid_body=truth.rigid_body, band=(1.0, 15.0)
    )
    chi2 = gain_errors_of(whole_fit(test)).rigid_chi2
    assert np.all(chi2[1:] < 30)  # of three degrees of freedom
    assert chi2[0] > 300 if gain != 1 else chi2[0] < 30  # beside what modes above the lines may add
