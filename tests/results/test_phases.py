"""The table of phases: what each left, with errors of a known truth."""

from dataclasses import replace

import numpy as np
import pytest

import sysid
from sysid.report.report import render
from sysid.results.answer import modal_assurance
from sysid.results.facts import COLUMNS, errors, seconds_in_words


@pytest.fixture(scope="module")
def result(request):
    case = request.getfixturevalue("random_case")
    problem = case(np.random.default_rng(0), "rigid_body", n=3, d=1, force=True)[1]
    strategy = sysid.Swarm.published(max_iterations=10, n_particles=20)
    return sysid.identify(problem, strategy=strategy, rng=1)


def test_errors_are_zero_of_the_truth_and_those_of_a_matrix_that_is_off(random_structure):
    truth = random_structure(np.random.default_rng(1), n=3, d=1)
    np.testing.assert_allclose(errors(truth, truth), 0, atol=1e-14)
    n = truth.n
    scaled = sysid.Structure(1.1 * truth.mass, 1.1 * truth.stiffness, truth.damping_ratios, n_base=1)
    off = errors(scaled, truth)  # frequencies and shapes stay
    np.testing.assert_allclose(off, [0, 0, 0.1, 0.1, 0.1], atol=1e-12)
    stiff = sysid.Structure(truth.mass, 1.21 * truth.stiffness, truth.damping_ratios, n_base=1)
    # sqrt(1.21) = 1.1 in frequency and, with the same ratios, in damping
    np.testing.assert_allclose(errors(stiff, truth), [0.1, 0, 0, 0.21, 0.1], atol=1e-12)
    assert n == 3


def test_an_undamped_truth_has_no_relative_error_of_damping(random_structure):
    truth = random_structure(np.random.default_rng(1), n=3, d=1)
    undamped = sysid.Structure(truth.mass, truth.stiffness, np.zeros(3), n_base=1)
    np.testing.assert_allclose(errors(truth, undamped), [0, 0, 0, 0, np.nan], atol=1e-14)


def test_a_mode_that_no_sensor_sees_agrees_with_none():
    """The second mass moves alone, and the only sensor is on the first."""
    M, K = np.diag([1.0, 1.0, 0.0]), np.array([[100.0, 0.0, -100.0], [0.0, 400.0, -400.0], [-100.0, -400.0, 500.0]])
    sensed = {"recovery": [[1.0, 0.0]], "rigid_body": [[1.0]]}
    truth = sysid.Structure(M, K, [0.01, 0.01], n_base=1, **sensed)
    np.testing.assert_array_equal(truth.mode_shapes[:, 1], 0)
    np.testing.assert_array_equal(errors(truth, truth), [0, 1, 0, 0, 0])
    np.testing.assert_array_equal(modal_assurance(truth.mode_shapes, truth.mode_shapes), [[1, 0], [0, 0]])


def test_a_phase_that_ended_at_no_structure_says_so(result):
    nowhere = replace(result.history.phases[0], x=np.zeros(result.problem.n_variables))  # no mass at all
    history = replace(result.history, phases=(nowhere, *result.history.phases[1:]))
    first, *others = replace(result, history=history).phases
    cells = dict(zip(COLUMNS, first, strict=True))
    assert cells["residual"] == "no structure"
    assert cells["M, %"] == cells["1 - MAC"] == "-"
    assert cells["candidates"] == str(nowhere.evaluations)
    assert others == result.phases[1:]


def test_each_phase_has_its_row_with_its_residual_and_errors(result):
    rows = result.phases
    assert [row[0] for row in rows] == ["start", "swarm", "local phase"]
    assert all(len(row) == len(COLUMNS) for row in rows)
    last = dict(zip(COLUMNS, rows[-1], strict=True))
    assert float(last["residual"]) == pytest.approx(result.residual, rel=5e-3)
    assert float(last["M, %"]) < 0.1 < 1 < float(dict(zip(COLUMNS, rows[1], strict=True))["M, %"])


def test_summary_and_report_show_them(result, no_pictures):
    assert "after  objective" in result.summary()
    assert "1 - MAC" in result.summary()
    assert "1 - MAC" in render(result)


def test_phases_are_stored(result, tmp_path):
    path = tmp_path / "r.h5"
    result.save(path)
    again = sysid.load(path)
    assert again.phases == result.phases


def test_the_answer_is_told_without_building_it_again(random_case, monkeypatch):
    """A graph of the matrices has some n³ operations; the modal strategy needs none, and its summary neither."""
    problem = random_case(np.random.default_rng(2), n=3, d=1)[1]
    result = sysid.identify(problem, strategy="modal", rng=0)
    monkeypatch.setattr(type(problem), "structure", lambda *given: pytest.fail("the matrices were built"))
    assert [row[0] for row in result.phases] == ["local phase"]


def test_seconds_are_neither_rounded_to_nothing_nor_written_with_a_power():
    told = {0.0004: "0.0004 s", 0.0312: "0.031 s", 4.21: "4.2 s", 99.4: "99 s", 99.6: "100 s", 1234.5: "1234 s"}
    assert {seconds: seconds_in_words(seconds) for seconds in told} == told


@pytest.mark.parametrize(("restarts", "told"), [(0, None), (1, "1 further swarm"), (3, "3 further swarms")])
def test_further_swarms_are_told_by_summary_and_report(result, restarts, told, no_pictures):
    searched = replace(result, history=replace(result.history, restarts=restarts))
    for page in (searched.summary(), render(searched)):
        assert "further swarm" not in page if told is None else f"{told} " in page.replace("\n", " ")
