"""Whole identifications as jobs: parts of a test and other models, and the figures that compare them."""

import json
from dataclasses import asdict, replace

import casadi as ca
import numpy as np
import pytest
from scipy.stats import norm

import sysid
from sysid.errors import InputError
from sysid.jobs import Band, Score, WithoutRun, WithoutSensor, moves, scored, submit

MASS = np.diag([300.0, 200.0, 0.0])
STRETCH = np.array([[1.0, 0, -1], [-1, 1, 0]])
SPRINGS, DAMPERS = np.array([3e5, 2e5]), np.array([900.0, 700.0])
FREQ = np.linspace(0.5, 10, 60)
MODULE = '''"""Two floors shaken twice."""

import sys
sys.path.insert(0, {folder!r})
from test_sweeps import problem
'''


def truth():
    K, C = (STRETCH.T @ np.diag(values) @ STRETCH for values in (SPRINGS, DAMPERS))
    return sysid.Structure(MASS, K, damping_matrix=C[:2, :2], n_base=1)


def problem(*, data=None, rng=0, noise=0.02, full=False):
    """Two runs, one three times the other; springs and dampers, or full matrices."""
    one, two = (sysid.simulate(truth(), FREQ, noise=noise, rng=seed) for seed in (rng, rng + 1))
    test = replace(
        one,
        base=np.concatenate([one.base, 3 * two.base]),
        response=np.concatenate([one.response, 3 * two.response]),
        response_std=None if noise == 0 else np.concatenate([one.response_std, 3 * two.response_std]),
    )
    further = [sysid.simulate(truth(), FREQ, noise=noise, rng=rng + 2)]
    if full:
        return sysid.Problem(test, mass=sysid.FullMass(500.0), validation=further, goal=0.5)
    k = sysid.Variable("spring", 2, lower=1e4, upper=1e6, log=True)
    c = sysid.Variable("damper", 2, lower=10, upper=1e4, log=True)
    K, C = (STRETCH.T @ ca.diag(values) @ STRETCH for values in (k, c))
    return sysid.Problem(test, mass=MASS, stiffness=K, damping=C, validation=further, goal=0.5)


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    file = tmp_path_factory.mktemp("sweeps") / "floors.py"
    file.write_text(MODULE.format(folder=__file__.rpartition("/")[0]))
    return sysid.Recipe(str(file))


@pytest.fixture(scope="module")
def result():
    return sysid.identify(problem(), rng=0)


def test_a_band_and_a_test_without_a_run_or_a_sensor_are_slices_of_the_records():
    whole = problem()
    test = whole.measurement
    band = Band(2.0, 4.0).of(whole)
    inside = (test.freq >= 2.0) & (test.freq <= 4.0)
    assert np.array_equal(band.measurement.response, test.response[..., inside])
    one = WithoutRun(0).of(whole).measurement
    assert np.array_equal(one.base, test.base[1:]) and np.array_equal(one.response, test.response[1:])
    assert np.array_equal(one.response_std, test.response_std[1:])
    other = WithoutSensor(0).of(whole)
    assert np.array_equal(other.measurement.response, test.response[:, 1:])
    # What the second sensor sees of both degrees of freedom.
    assert np.array_equal(other.recovery, [[0.0, 1.0]])
    for made in (band, other):  # of the whole test
        assert made.goal is None and not made.validation


@pytest.mark.parametrize("change", [Band(0.4, 4.0), WithoutRun(1), WithoutSensor(1)])
def test_each_part_of_exact_records_gives_the_truth_and_predicts_the_rest(change):
    whole = problem(noise=0.0)
    result = sysid.identify(change.of(whole), rng=0)
    np.testing.assert_allclose(result.values["spring"], SPRINGS, rtol=1e-6)
    np.testing.assert_allclose(result.values["damper"], DAMPERS, rtol=1e-5)
    assert change.predicted(whole, result) < 1e-6


def test_what_is_predicted_is_the_residual_of_what_was_left_out(result):
    whole = problem()
    test, s = whole.measurement, result.structure
    left, size = test.relative - test.predict(s), test.relative
    above = test.freq > 4.0
    for change, part in (
        (Band(0.0, 4.0), np.s_[..., above]),
        (WithoutRun(1), np.s_[1]),
        (WithoutSensor(1), np.s_[:, 1]),
    ):
        expected = np.linalg.norm(left[part]) / np.linalg.norm(size[part])
        assert change.predicted(whole, result) == pytest.approx(expected, rel=1e-12)
    assert np.isnan(Band(0.0, 20.0).predicted(whole, result))  # nothing is outside


def test_full_matrices_are_those_of_the_other_sensors_and_do_not_predict_the_one_left_out():
    whole = problem(full=True)
    result = sysid.identify(WithoutSensor(0).of(whole), rng=0)
    np.testing.assert_allclose(result.structure.natural_frequencies, truth().natural_frequencies, rtol=1e-2)
    assert result.structure.mode_shapes.shape[0] == 1
    assert np.isnan(WithoutSensor(0).predicted(whole, result))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (WithoutRun(2), "there is no run 3: the test has 2"),
        (WithoutSensor(5), "there is no sensor 6: the test has 2"),
        (Band(20.0, 30.0), "no line between 20 and 30 Hz"),
    ],
)
def test_a_part_that_is_not_there_is_told(change, told):
    with pytest.raises(InputError, match=told):
        change.of(problem())


def test_a_band_that_is_none_is_refused():
    for low, high in ((4.0, 2.0), (-1.0, 2.0), (1.0, np.nan)):
        with pytest.raises(InputError, match="Band"):
            Band(low, high)


def test_the_deviance_is_that_of_normal_noise_of_one_size(result):
    """Differences between two models of the same records, against SciPy's normal law."""
    full = sysid.identify(problem(full=True), rng=0)
    made = []
    for one in (result, full):
        test = one.measurement
        e = (test.relative - test.predict(one.structure)) / test.response_std
        parts = np.concatenate([e.real.ravel(), e.imag.ravel()])
        made.append(-2 * np.sum(norm.logpdf(parts, scale=np.sqrt(np.mean(parts**2)))))
    springs, matrices = scored(result), scored(full)
    assert matrices.deviance - springs.deviance == pytest.approx(made[1] - made[0], abs=1e-6)
    # Two springs and two dampers; of a mode: frequency, damping ratio, two shape entries by one participation.
    assert (springs.parameters, matrices.parameters) == (4, 8)
    assert springs.numbers == 2 * 2 * 2 * FREQ.size
    assert springs.aic - springs.deviance == 8
    assert springs.bic - springs.deviance == pytest.approx(4 * np.log(480))


def test_the_prediction_of_a_whole_test_is_that_of_its_validation(result):
    assert scored(result).predicted == pytest.approx(result.problem.validation[0].residual(result.structure), rel=1e-12)


def _score(frequencies, stds, **others):
    ratios = tuple(0.01 for _ in frequencies)
    unknown = tuple(np.nan for _ in frequencies)
    given = {"determined": True, "parameters": 4, "numbers": 9, "deviance": 1.0, "predicted": np.nan, "ratios": ratios}
    given |= {"unknowns": {}, "unknown_stds": {}, "ratio_stds": unknown, "frequencies": frequencies}
    return Score(**given, frequency_stds=stds, **others)


def test_steps_are_counted_by_what_noise_makes_of_them():
    own, part = _score((1.0, 2.0), (0.03, 0.1)), _score((1.2, 2.1), (0.05, 0.1))
    of_part = {move.name: move for move in moves(own, part, part=True)}
    # A mode 20 % away is another one; the difference of both variances, at least a tenth of the part's.
    assert set(of_part) == {"mode 2: frequency, Hz", "mode 2: damping ratio"}
    step = of_part["mode 2: frequency, Hz"]
    assert step.deviations == pytest.approx(0.1 / np.sqrt(0.1 * 0.1**2))
    assert step.relative == pytest.approx(0.05)
    near = moves(own, _score((1.01,), (0.05,)), part=True)[0]
    assert near.deviations == pytest.approx(0.01 / 0.04)  # 0.05² - 0.03² = 0.04²
    other = moves(own, _score((1.01,), (0.05,)), part=False)[0]
    assert other.deviations == pytest.approx(0.01 / 0.05)


def test_steps_of_exact_records_have_no_deviations():
    exact = sysid.identify(problem(noise=0.0), rng=0)
    steps = moves(scored(exact), scored(exact), part=True)
    assert len(steps) == 8 and all(np.isnan(step.deviations) for step in steps)


def test_noise_moves_a_part_of_the_records_by_its_stated_deviations():
    """Squares of normal steps: their mean over 12 draws and four unknowns, which are nearly independent, is about 1."""
    squares = []
    for seed in range(12):
        whole = problem(rng=10 * seed)
        own, part = (scored(sysid.identify(one, rng=0)) for one in (whole, WithoutRun(1).of(whole)))
        squares += [step.deviations**2 for step in moves(own, part, part=True) if step.name[:4] in ("spri", "damp")]
    assert len(squares) == 48
    assert 0.4 < np.mean(squares) < 1.9  # four deviations of the mean of 48 squares, 0.82, and more below as it is skew


def test_jobs_go_on_from_the_ledger_with_their_scores(recipe, result, tmp_path):
    changes = [None, WithoutRun(0), WithoutRun(9)]
    ends = list(submit(recipe, changes=changes, out=tmp_path))
    assert [end.success for end in ends] == [True, True, False]
    assert ends[2].message == "there is no run 10: the test has 2" and not ends[2].has_result
    assert ends[0].residual == result.residual and ends[0].score == scored(result)
    again = list(submit(recipe, changes=changes[:2], out=tmp_path))
    assert [one.score for one in again] == [one.score for one in ends[:2]]
    assert Score.from_tree(json.loads(json.dumps(asdict(ends[1].score)))) == ends[1].score


def test_changes_begin_at_the_unknowns_of_a_result(recipe, result, tmp_path):
    started = replace(recipe, start=tuple(result.x.tolist()))
    end = next(submit(started, changes=[WithoutRun(0)]))
    whole = sysid.identify(WithoutRun(0).of(problem()), rng=0)
    np.testing.assert_allclose(end.score.unknowns["spring"], whole.values["spring"], rtol=1e-6)


def test_what_excludes_each_other_and_what_is_no_change_is_refused(recipe):
    for given, told in (
        ({"changes": [WithoutRun(0)], "starts": 2}, "exclude starts and draws"),
        ({"strategy": "auto", "starts": 2}, "exclude starts and draws"),
        ({"strategy": "fast"}, "strategy 'fast' is unknown"),
        ({"changes": ["run 1"]}, "changes holds a str; give Band"),
    ):
        with pytest.raises(InputError, match=told):
            submit(recipe, **given)
