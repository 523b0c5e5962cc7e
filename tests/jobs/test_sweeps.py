"""Whole identifications as jobs: parts of a test and other models, and the figures that compare them."""

import os
import signal
from argparse import Namespace
from dataclasses import asdict, replace
from itertools import combinations

import casadi as ca
import numpy as np
import pytest
from scipy.stats import norm

import sysid
from sysid.cli.output import Output
from sysid.cli.refine import sweep_of
from sysid.errors import InputError, SolverError
from sysid.jobs import Band, NumberOfModes, Score, WithoutRun, WithoutSensor, moves, scored, submit
from sysid.modal_analysis.residues import linear_residues
from sysid.modal_analysis.vector_fitting import find_poles
from sysid.search.continuation import descend
from sysid.search.session import DeferredInterrupt, Session
from sysid.search.strategy import as_unknowns

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
MASS = np.diag([300.0, 200.0, 0.0])
STRETCH = np.array([[1.0, 0, -1], [-1, 1, 0]])
SPRINGS, DAMPERS = np.array([3e5, 2e5]), np.array([900.0, 700.0])
FREQ = np.linspace(0.5, 10, 60)
MODULE = '''"""Two floors shaken twice."""

import sys
sys.path.insert(0, {folder!r})
from test_sweeps import problem
'''

FULL = """

def problem(*, data=None, rng=0):
    return whole(full=True)
"""

TWO_WAYS = """'A mass on two springs, shaken along each.'
import casadi as ca
import numpy as np

import sysid


def problem(*, data=None, rng=0):
    M, K = np.diag([9.0, 9.0, 0.0, 0.0]), np.kron([[1, -1], [-1, 1]], np.diag([4e4, 9e4]))
    truth = sysid.Structure(M, K, [0.01, 0.01], n_base=2)
    k = sysid.Variable("spring", 2, lower=1e4, upper=1e6, log=True)
    test = sysid.simulate(truth, np.linspace(5, 20, 40), noise=0.01, rng=rng)
    K = ca.vertcat(ca.horzcat(ca.diag(k), -ca.diag(k)), ca.horzcat(-ca.diag(k), ca.diag(k)))
    return sysid.Problem(test, mass=M, stiffness=K, damping=np.array([0.01, 0.01]))
"""


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
    assert change.predicted(whole.prepared, result) < 1e-6


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
        assert change.predicted(whole.prepared, result) == pytest.approx(expected, rel=1e-12)
    assert np.isnan(Band(0.0, 20.0).predicted(whole.prepared, result))  # nothing is outside


def spoiled(*, data=None, rng=0):
    """The problem with spikes of 50 times the noise in its second run."""
    given = problem()
    test, response = given.measurement, given.measurement.response.copy()
    response[1, :, ::15] += 50 * test.response_std[1, :, ::15]
    return replace(given, measurement=replace(test, response=response), loss="huber")


def with_further_test(*, data=None, rng=0, loss="huber"):
    """The same, fitted twice."""
    given = spoiled()
    again = sysid.FurtherTest(
        given.measurement, mass=MASS, stiffness=STRETCH.T @ np.diag(SPRINGS) @ STRETCH, damping=np.eye(2)
    )
    return replace(given, residuals=[again], loss=loss)


def test_spikes_are_not_to_be_predicted_under_hubers_loss(result, tmp_path):
    """The run that was left out is predicted as well as without its spikes."""
    file = tmp_path / "spikes.py"
    file.write_text(MODULE.format(folder=__file__.rpartition("/")[0]).replace("problem", "spoiled as problem"))
    (end,) = submit(sysid.Recipe(str(file), start=tuple(result.x)), changes=[WithoutRun(1)])
    assert end.score.predicted == pytest.approx(WithoutRun(1).predicted(problem().prepared, result), rel=0.05)


def test_a_variant_with_hubers_loss_has_the_same_further_tests(result, tmp_path):
    """Spikes and all, though it is fitted to others; without them it would be another test."""
    file = tmp_path / "twice.py"
    named = MODULE.format(folder=__file__.rpartition("/")[0]).replace("problem", "with_further_test as problem")
    file.write_text(named)
    own = replace(result, problem=with_further_test(loss="squares"))
    sweep = sweep_of(Namespace(variants=[str(file)]), own, sysid.Recipe(str(file)), Output())
    assert sweep.titles == (str(file),)


def test_full_matrices_are_those_of_the_other_sensors_and_do_not_predict_the_one_left_out():
    whole = problem(full=True)
    result = sysid.identify(WithoutSensor(0).of(whole), rng=0)
    np.testing.assert_allclose(result.structure.natural_frequencies, truth().natural_frequencies, rtol=1e-2)
    assert result.structure.mode_shapes.shape[0] == 1
    assert np.isnan(WithoutSensor(0).predicted(whole.prepared, result))


def test_described_sensors_may_be_left_out_of_a_lumped_mass():
    """The degree of freedom stays without its sensor, whether or not places of sensors were stated."""
    test = sysid.simulate(truth(), np.linspace(0.5, 12.0, 80), noise=0.01, rng=1)
    places = [sysid.Sensor(f"floor {i}", position=(0.0, 0.0, i + 1.0), axis="x") for i in range(test.n_sensors)]
    total = float(np.trace(truth().mass))
    plain, described = (
        sysid.identify(WithoutSensor(0).of(sysid.Problem(one, mass=sysid.LumpedMass(total))), rng=0)
        for one in (test, replace(test, sensors=places))
    )
    assert described.success
    np.testing.assert_array_equal(described.x, plain.x)
    assert [sensor.name for sensor in described.structure.sensors] == ["floor 1"]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (WithoutRun(2), r"there is no run 3 \(run=2, counted from 0\): the test has 2"),
        (WithoutSensor(5), r"there is no sensor 6 \(sensor=5, counted from 0\): the test has 2"),
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
    """Differences between models of the same records and noises, against SciPy's normal law."""
    full = sysid.identify(problem(full=True), rng=0)
    test = result.measurement
    unstated = replace(result, problem=replace(result.problem, measurement=replace(test, response_std=None)))
    uneven = replace(test, response_std=test.response_std * np.linspace(1, 2, FREQ.size))
    uneven = replace(result, problem=replace(result.problem, measurement=uneven))
    made = []
    for one in (result, full, unstated, uneven):
        test = one.measurement
        e = test.relative - test.predict(one.structure)
        std = np.ones(e.shape) if test.response_std is None else test.response_std
        size = np.sqrt(np.mean(np.abs(e / std) ** 2) / 2) * std  # of a real or an imaginary part
        made.append(-2 * np.sum(norm.logpdf(e.real, scale=size) + norm.logpdf(e.imag, scale=size)))
    scores = [scored(one) for one in (result, full, unstated, uneven)]
    steps = [score.deviance - scores[0].deviance for score in scores]
    np.testing.assert_allclose(steps, np.array(made) - made[0], atol=1e-6)
    # Two springs and two dampers; of a mode: frequency, damping ratio, two shape entries by one participation; a scale.
    assert [score.parameters for score in scores] == [5, 9, 5, 5]
    assert scores[0].numbers == 2 * 2 * 2 * FREQ.size
    assert scores[0].aic - scores[0].deviance == 10
    assert scores[0].bic - scores[0].deviance == pytest.approx(5 * np.log(480))


@pytest.mark.parametrize("stated", [True, False])
def test_spikes_hardly_change_the_figures_of_hubers_loss(result, stated):
    """One number of 60 is off by 30 deviations: a spring that is 3 % off stays clearly worse, the noise that of most.

    The mean square of the misfit is 1 + 900 / 60 = 16 times as large, which takes over half of the deviance's step.
    """
    test, made = result.measurement, []
    for spikes in (0, 30):
        response = test.response.copy()
        response[:, :, 10] += spikes * test.response_std[:, :, 10]
        records = replace(test, response=response, response_std=test.response_std if stated else None)
        given = replace(result.problem, measurement=records, loss="huber")
        ends = [(x, given.structure(x)) for x in (result.x, result.x * [1.03, 1, 1, 1])]
        own, off = (scored(replace(result, problem=given, x=x, structure=structure)) for x, structure in ends)
        made.append((off.deviance - own.deviance, own.noise))
    (step, noise), (spoiled_step, spoiled_noise) = made
    assert spoiled_step > 0.7 * step > 300
    assert spoiled_noise == pytest.approx(noise, rel=0.15)


@pytest.mark.parametrize(
    ("force", "total", "expected"),
    [
        (False, 500.0, 8 + 1),
        # Each mode is weighed, and what no mode carries; dampers couple the two modes; the noises of force and
        # accelerations share a scale.
        (True, None, 10 + 1 + 1 + 1),
        (True, 500.0, 10 + 1 + 1),
    ],
)
def test_parameters_of_free_matrices_are_the_numbers_of_a_modal_model(force, total, expected):
    test = sysid.simulate(truth(), FREQ, noise=0.01, force=force, rng=0)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass(total)), rng=0)
    assert result.structure.modal_damping == (not force)
    assert scored(result).parameters == expected


def test_rayleigh_damping_counts_two_numbers_whatever_the_modes():
    stretch = np.array([[1.0, 0, 0, -1], [-1, 1, 0, 0], [0, -1, 1, 0]])
    M, K = np.diag([3.0, 2, 1, 0]), stretch.T @ np.diag([3e3, 2e3, 1e3]) @ stretch
    C = 0.1 * M[:3, :3] + 1e-4 * K[:3, :3]
    tower = sysid.Structure(M, K, damping_matrix=C, n_base=1)
    test = sysid.simulate(tower, np.linspace(1, 12, 80), noise=0.01, rng=0)
    given = sysid.Problem(test, mass=sysid.FullMass(6.0), damping=sysid.ProportionalDamping((0.01, 1), (1e-5, 1e-3)))
    # Three frequencies, three times three shape entries by a participation, two coefficients, the scale of the noise.
    assert scored(sysid.identify(given, rng=0)).parameters == 3 + 9 + 2 + 1


def test_the_prediction_of_a_whole_test_is_that_of_its_validation(result):
    assert scored(result).predicted == pytest.approx(result.problem.validation[0].residual(result.structure), rel=1e-12)


def _score(frequencies, stds, noise=1.0):
    values = {f"mode {i + 1}: frequency, Hz": f for i, f in enumerate(frequencies)}
    values |= {f"mode {i + 1}: damping ratio": 0.01 for i in range(len(frequencies))}
    known = {f"mode {i + 1}: frequency, Hz": std for i, std in enumerate(stds)}
    return Score(True, 4, 9, 1.0, np.nan, noise, len(frequencies), values, known)


def test_steps_are_counted_by_what_noise_makes_of_them():
    own, part = _score((1.0, 2.0), (0.03, 0.1)), _score((1.2, 2.1), (0.05, 0.1))
    of_part = {move.name: move for move in moves(own, part, part=True)}
    # A mode 20 % away is another one; a part that knows as much as the whole has a step of rounding alone.
    assert set(of_part) == {"mode 2: frequency, Hz", "mode 2: damping ratio"}
    step = of_part["mode 2: frequency, Hz"]
    assert step.deviations == pytest.approx(0.1 / np.sqrt(0.01 * 0.1**2))
    assert step.relative == pytest.approx(0.05)
    near = moves(own, _score((1.01,), (0.05,)), part=True)[0]
    assert near.deviations == pytest.approx(0.01 / 0.04)  # 0.05² - 0.03² = 0.04²
    other = moves(own, _score((1.01,), (0.05,)), part=False)[0]
    assert other.deviations == pytest.approx(0.01 / 0.05)
    assert np.isnan(moves(own, _score((1.01,), ()), part=False)[0].deviations)


def test_a_step_to_a_part_with_less_noise_is_the_difference_of_two_means():
    """Means of a hundred numbers of variance 1 and of a hundred of variance 99, fitted as if all were alike.

    The whole then supposes 50 of each: 50 / 200. Its mean is half of each part's: the step is half their difference.
    """
    whole, part = _score((1.0,), (np.sqrt(50 / 200),), noise=50.0), _score((1.1,), (np.sqrt(1 / 100),), noise=1.0)
    step = moves(whole, part, part=True)[0]
    assert 0.1 / step.deviations == pytest.approx(0.5 * np.sqrt(1 / 100 + 99 / 100))


def test_an_unknown_may_be_called_after_modes():
    own, other = (replace(_score((), ()), values={"mode mass": value}) for value in (2.0, 2.5))
    assert [(step.name, step.value) for step in moves(own, other, part=False)] == [("mode mass", 2.5)]


def test_modes_that_share_a_frequency_go_to_one_each():
    steps = moves(_score((1.0, 1.001), (0.1, 0.1)), _score((1.0011, 1.0012), (0.1, 0.1)), part=False)
    assert [(step.name, step.value) for step in steps[::2]] == [
        ("mode 1: frequency, Hz", 1.0011), ("mode 2: frequency, Hz", 1.0012),
    ]  # fmt: skip


def test_modes_of_two_directions_that_cross_are_told_by_their_shapes():
    """And a mode that the records do not show is none, however near its frequency."""
    own = replace(_score((1.0, 1.02), (0.1, 0.1)), shapes=[[1.0, 0.0], [0.0, 2.0]])
    crossed = replace(_score((1.01, 1.03), (0.1, 0.1)), shapes=[[0.1, 3.0], [-1.0, 0.1]])
    assert [step.value for step in moves(own, crossed, part=False)[::2]] == [1.03, 1.01]
    unseen = replace(crossed, shapes=[[0.1, 0.2], [-1.0, 1.0]])
    assert [(step.name, step.value) for step in moves(own, unseen, part=False)[::2]] == [
        ("mode 2: frequency, Hz", 1.01),
    ]  # fmt: skip


def test_a_bad_model_does_not_hide_its_steps_behind_its_own_misfit():
    """Twenty times the misfit makes twenty times the deviations; of the noise of the better fit it has as few."""
    good, bad = _score((1.0,), (0.01,), noise=1.0), _score((1.06,), (0.2,), noise=400.0)
    assert moves(good, bad, part=False)[0].deviations == pytest.approx(6.0)
    assert moves(bad, good, part=False)[0].deviations == pytest.approx(-6.0)


def test_without_the_one_run_along_an_axis_its_modes_cannot_be_found():
    full = problem(full=True)
    assert WithoutRun(0).of(full).measurement.n_runs == 1
    tower = sysid.catalogue.build(sysid.Recipe("cantilever_tower", parameters={"elements": 2, "force": False}))
    with pytest.raises(
        InputError, match="without run 2 the base does not move in every direction: modes that this run"
    ):
        WithoutRun(1).of(tower)


def one_run(*, data=None, rng=0):
    """The problem with its first run."""
    return WithoutRun(1).of(problem())


def test_a_line_of_as_many_numbers_as_unknowns_is_no_fit(result, tmp_path):
    """Two sensors give four numbers at a line, for two springs and two dampers and the scale of the noise."""
    file = tmp_path / "one_run.py"
    file.write_text(MODULE.format(folder=__file__.rpartition("/")[0]).replace("problem", "one_run as problem"))
    (end,) = submit(sysid.Recipe(str(file), start=tuple(result.x)), changes=[Band(0.5, 0.51)])
    assert not end.success and end.has_result
    assert (end.score.numbers, end.score.parameters) == (4, 5)


def test_steps_of_exact_records_have_no_deviations():
    exact = sysid.identify(problem(noise=0.0), rng=0)
    steps = moves(scored(exact), scored(exact), part=True)
    assert len(steps) == 8 and all(np.isnan(step.deviations) for step in steps)


@pytest.mark.parametrize("ratio", [None, 10.0])
def test_noise_moves_a_part_of_the_records_by_its_stated_deviations(ratio):
    """Squares of normal steps: their mean over draws and unknowns, which are nearly independent, is about 1.

    Stated noise with a fifth of the information left out, whose steps are small beside the part's own deviations; and
    noise that is not stated, ten times larger in the run that is left out.
    """
    squares = []
    for seed in range(6):
        one, two = (sysid.simulate(truth(), FREQ, noise=0.02 * f, rng=30 * seed + f) for f in (1, int(ratio or 2)))
        test = replace(
            one,
            base=np.concatenate([one.base, two.base]),
            response=np.concatenate([one.response, two.response]),
            response_std=None if ratio else np.concatenate([one.response_std, two.response_std]),
        )
        whole = replace(problem(), measurement=test)
        own, part = (scored(_from_truth(made)) for made in (whole, WithoutRun(1).of(whole)))
        squares += [step.deviations**2 for step in moves(own, part, part=True) if step.name[:4] in ("spri", "damp")]
    assert len(squares) == 24
    assert 0.4 < np.mean(squares) < 1.9  # three deviations of the mean of 24 squares: 0.87


def _from_truth(made):
    """The fit by gradients from the truth, not judged."""
    session = Session([], DeferredInterrupt())
    answer = descend(made.prepared, as_unknowns(made.prepared, np.concatenate([SPRINGS, DAMPERS])), [], session)
    assert answer.success
    return sysid.Identification(made.structure(answer.x), made, answer.x, "local phase", 0, sysid.History(), ())


def test_so_many_modes_are_those_that_the_records_need_most():
    """Against all subsets of the poles, each with free residues."""
    tower = sysid.catalogue.build(sysid.Recipe("cantilever_tower", parameters={"elements": 2, "force": False}))
    test, poles = tower.measurement, find_poles(tower.measurement)
    assert poles.omega.size == 4
    for count in (2, 3):
        subsets = [list(kept) for kept in combinations(range(4), count)]
        best = min(subsets, key=lambda kept: linear_residues(test, poles.omega[kept], poles.ratios[kept])[1])
        found = sysid.identify(NumberOfModes(count).of(tower), strategy=sysid.Modal(modes=count), rng=0)
        expected = poles.omega[best] / (2 * np.pi)
        np.testing.assert_allclose(found.structure.natural_frequencies, expected, rtol=0.02)
    with pytest.raises(InputError, match="modes=5, and SpectralStiffness states 4 frequencies"):
        sysid.identify(tower, strategy=sysid.Modal(modes=5), rng=0)
    with pytest.raises(InputError, match="open only where mass and stiffness are free"):
        NumberOfModes(2).of(problem())


def test_a_job_of_so_many_modes_predicts_the_validation_tests(tmp_path):
    file = tmp_path / "full.py"
    file.write_text(MODULE.format(folder=__file__.rpartition("/")[0]).replace("problem\n", "problem as whole\n") + FULL)
    one, two = submit(sysid.Recipe(str(file)), changes=[NumberOfModes(1), NumberOfModes(2)])
    assert len(one.score.frequencies) == 1 and one.score.aic > two.score.aic + 100
    assert two.score.predicted < 0.03 < one.score.predicted < 1


def test_jobs_go_on_from_the_ledger_with_their_scores(recipe, result, tmp_path):
    changes = [None, WithoutRun(0), WithoutRun(9)]
    ends = list(submit(recipe, changes=changes, out=tmp_path))
    assert [end.success for end in ends] == [True, True, False]
    assert ends[2].message == "there is no run 10 (run=9, counted from 0): the test has 2" and not ends[2].has_result
    assert ends[0].residual == result.residual
    np.testing.assert_equal(asdict(ends[0].score), asdict(scored(result)))  # NaN too
    again = list(submit(recipe, changes=changes[:2], out=tmp_path, executor=lambda: pytest.fail("computed again")))
    for one, other in zip(again, ends, strict=False):
        np.testing.assert_equal(asdict(one.score), asdict(other.score))


def test_changes_begin_at_the_unknowns_of_a_result(recipe, result, monkeypatch):
    whole = sysid.identify(WithoutRun(0).of(problem()), rng=0)
    started = replace(recipe, start=tuple(result.x.tolist()))
    monkeypatch.setattr("sysid.jobs.job.identify", None)
    end = next(submit(started, changes=[WithoutRun(0)]))
    for i in (1, 2):
        assert end.score.values[f"spring {i}"] == pytest.approx(whole.values["spring"][i - 1], rel=1e-6)


def test_a_stated_strategy_is_taken_also_where_there_is_a_start(recipe, result):
    started = replace(recipe, start=tuple(result.x.tolist()))
    end = next(submit(started, changes=[WithoutRun(0)], strategy="modal"))
    assert not end.has_result and sysid.Modal().refusal(problem().prepared, None) in end.message
    assert "'modal'" in end.message


def test_what_the_rest_does_not_tell_is_not_predicted(tmp_path):
    """Two directions that do not couple: without the run of one its spring is unseen."""
    file = tmp_path / "two_ways.py"
    file.write_text(TWO_WAYS)
    both, one = submit(sysid.Recipe(str(file)), changes=[None, WithoutRun(1)])
    assert both.score.parameters == one.score.parameters + 1
    assert np.isnan(one.score.predicted)


def test_ctrl_c_before_a_first_fit_is_no_result(recipe, monkeypatch, ctrl_c):
    def stopped(*arguments, **options):
        os.kill(os.getpid(), signal.SIGINT)
        raise SolverError("stopped before there was a first fit: nothing is identified")

    monkeypatch.setattr("sysid.jobs.job.identify", stopped)
    with pytest.raises(KeyboardInterrupt):
        next(submit(recipe, strategy="auto"))


def test_what_excludes_each_other_and_what_is_no_change_is_refused(recipe):
    for given, told in (
        ({"changes": [WithoutRun(0)], "starts": 2}, "without starts"),
        ({"strategy": "auto", "starts": 2}, "without starts"),
        ({"strategy": "fast"}, "strategy 'fast' is unknown"),
        ({"strategy": "swarm", "draws": 2}, "draws need Recipe.start"),
        ({"changes": ["run 1"]}, "changes holds a str; give Band"),
        ({"changes": WithoutRun(1)}, "give a list of Band, WithoutRun"),
    ):
        with pytest.raises(InputError, match=told):
            submit(recipe, **given)
