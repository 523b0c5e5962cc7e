"""Reading of a result by the benchmarks of records: shares of intervals, errors over the bound, verdicts, levels."""

import importlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import sysid

ROOT = Path(__file__).resolve().parents[2]
FREQUENCY_OFF = 3.0  # deviations


@pytest.fixture(scope="module")
def modules():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        names = ("simulated", "cramer_rao", "trial", "coupled_records")
        return SimpleNamespace(**{name: importlib.import_module(f"benchmarks.records.{name}") for name in names})


@pytest.fixture(scope="module")
def judged(modules):
    """A result whose stiffness is too large by a factor, so that its frequencies are three deviations off."""
    truth = modules.simulated.four_storeys().structure
    n, size = truth.n, lambda x: 1e-3 * np.abs(x)
    std = modules.cramer_rao.Bound(
        size(truth.natural_frequencies), size(truth.damping_ratios), np.zeros((n, n)),
        size(truth.stiffness[:n, :n]), size(truth.damping),
    )  # fmt: skip
    factor = (1 + FREQUENCY_OFF * 1e-3) ** 2
    found = sysid.Structure(truth.mass, factor * truth.stiffness, truth.damping_ratios, n_base=1)

    def interval(name, level):
        assert level == 0.95
        value = getattr(found, name)
        value = value[:n, :n] if value.ndim == 2 else value
        return np.array([value - 1.96 * getattr(std, name), value + 1.96 * getattr(std, name)])

    levels = modules.simulated.Levels(np.array([0.01]), np.full(n, 0.02), np.array([5.0]))
    result = SimpleNamespace(
        structure=found, determined=True, undetermined=("a record is wrong", "mode 2 is open"),
        contradictions=("a record is wrong",), of_kind=lambda kind: (), uncertainty=SimpleNamespace(interval=interval),
        noise=SimpleNamespace(base=1.04 * levels.base, response=0.98 * levels.response, force=None),
    )  # fmt: skip
    return modules.trial.judged("chain", result, truth, std, levels)


def test_a_result_is_compared_cell_by_cell_with_truth_and_bound(judged):
    assert judged.held["natural_frequencies"] == [False] * 4
    np.testing.assert_allclose(judged.ratios["natural_frequencies"], FREQUENCY_OFF)
    assert judged.held["damping_ratios"] == [True] * 4
    assert judged.held["mass"] == []  # what is stated
    np.testing.assert_allclose(np.abs(judged.ratios["stiffness"]), 6.009)  # seven entries, no others are free
    assert len(judged.ratios["stiffness"]) == 7
    assert judged.stated == pytest.approx({name: 1.0 for name in judged.held if name != "mass"}, rel=1e-4)
    np.testing.assert_allclose(judged.levels, [0.98] * 4 + [1.04])
    assert judged.accusations == ("a record is wrong",)


def test_lines_are_met_or_not_by_the_figures(modules, judged):
    trial = modules.trial
    failed = trial.attempt("chain", lambda: 1 / 0)
    assert failed.said == "ZeroDivisionError: division by zero"
    assert trial.verdicts("", [judged] * 3, determined=True).met
    assert not trial.verdicts("", [judged, failed], determined=True).met
    assert not trial.verdicts("", [judged], determined=False).met
    assert trial.levels_found("", [judged]).met
    assert not trial.levels_found("", [judged, failed]).met
    pooled, worst = trial.coverages("", [judged] * trial.PROVEN)
    held = np.concatenate([*judged.held.values()])
    assert pooled.figure == f"{held.mean():.4f}"
    assert (pooled.met, worst.met, worst.figure) == (False, False, "0")
    pooled, worst = trial.errors("", [judged] * trial.PROVEN)
    assert (pooled.met, worst.met) == (False, False)
    assert trial.stated("", [judged]).met
    assert not trial.stated("", [replace(judged, stated={**judged.stated, "damping": 1.2})]).met
    assert not trial.stated("", [failed]).met
    assert worst.figure == f"{np.abs(np.concatenate([*judged.ratios.values()])).max():.4g}"


def test_modes_are_paired_once_and_only_where_near(modules):
    true, found = np.array([1.0, 1.1, 5.0]), np.array([1.04, 1.12, 4.0, 9.0])
    pairs = modules.coupled_records.matched(true, found, np.full(3, 0.1))
    assert pairs == [(0, 0), (1, 1)]


def test_the_rise_of_chi_square_is_what_the_other_modes_cannot_follow(modules):
    """Against least squares on the numbers themselves."""
    simulated, coupled = modules.simulated, modules.coupled_records
    setting = simulated.coupled(3)
    run = setting.run(np.random.default_rng(0))
    levels = setting.with_noise(run.records(), np.random.default_rng(1))[1]
    rises = coupled.chi_square_rises(setting, run, levels)
    n, d = run.modes.gamma.shape
    J, parts = modules.cramer_rao.whitened(run.modes, run, levels, setting.lines, force=True)
    k = 1
    own = [i * n + k for i in range(n)] + [n * n + k * d + j for j in range(d)]
    own += [n * (n + d) + k, n * (n + d + 1) + k, J.shape[1] - 2 * n + k, J.shape[1] - n + k]
    columns = np.delete(J, own, axis=1)
    columns, target = np.vstack([columns.real, columns.imag]), np.concatenate([parts[:, k].real, parts[:, k].imag])
    columns /= np.linalg.norm(columns, axis=0)
    left = target - columns @ np.linalg.lstsq(columns, target)[0]
    assert rises[k] == pytest.approx(2 * left @ left, rel=1e-6)
