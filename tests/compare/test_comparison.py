"""Methods side by side: who runs, who refuses and why, what the figures are, and how it ends."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest

import sysid
from sysid.cli.output import strict_json
from sysid.compare import peers
from sysid.compare.comparison import Comparison, as_csv, compare, comparison_text
from sysid.compare.peers import Status, errors_of
from sysid.search.modal import Modal

K = 4e3 * np.array([[2.0, -1.0, -1.0], [-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
TRUTH = sysid.Structure(np.diag([2.0, 1.0, 0.5]), K, [0.01, 0.02], n_base=1)
FREQ = np.linspace(2.0, 20.0, 40)


def two_masses(*, noise=0.0, **given):
    test = sysid.simulate(TRUTH, FREQ, noise=noise, rng=0)
    return sysid.Problem(test, mass=sysid.LumpedMass(3.0), **{"reference": TRUTH, "goal": 2 * noise or 1e-6} | given)


@pytest.fixture
def alone(monkeypatch):
    """No extra is installed."""
    monkeypatch.setattr(peers, "missing_packages", lambda: ["pymoo"])


def after_the_first(result):
    """A listener's Ctrl-C: what follows is not looked at, and takes seconds."""
    raise KeyboardInterrupt


@pytest.fixture(scope="module")
def compared():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(peers, "missing_packages", lambda: ["pymoo"])
        return compare(two_masses(), rng=3)


def test_every_strategy_has_a_row_and_the_one_that_refuses_its_own_reason(compared):
    results = {result.name: result for result in compared.results}
    assert list(results) == ["modal", "continuation", "swarm", "hpso-ls"]
    assert results["modal"].status is results["swarm"].status is Status.FIT
    assert results["continuation"].status is Status.REFUSED
    assert results["continuation"].message == sysid.Continuation().refusal(two_masses().prepared, None)
    assert compared.success
    assert not compared.interrupted


def test_figures_are_those_of_the_same_identification(compared):
    swarm = next(result for result in compared.results if result.name == "swarm")
    result = sysid.identify(two_masses(), strategy="swarm", rng=3)
    assert (swarm.residual, swarm.after) == (result.residual, result.objective)
    assert swarm.evaluations == result.history.evaluations > 0
    assert swarm.before == result.history.swarm
    # A lumped mass with its total is determined: the truth itself is found.
    np.testing.assert_allclose(swarm.errors, 0.0, atol=1e-5)
    phases = dict(swarm.phases)
    assert phases["swarm"][-1, 1] == result.history.swarm
    assert np.all(np.diff(np.concatenate([curve[:, 0] for curve in phases.values()])) >= 0)


def test_errors_are_frobenius_norms_over_the_references_in_percent():
    other = sysid.Structure(np.diag([2.0, 2.0, 0.5]), 3 * K, damping_matrix=TRUTH.damping, n_base=1)
    # |diag(0, 1)| / |diag(2, 1)|, and three times the matrix.
    np.testing.assert_allclose(errors_of(other, TRUTH), [100 / np.sqrt(5), 200.0, 0.0], atol=1e-9)
    assert np.all(np.isnan(errors_of(other, None)))
    other = sysid.Structure(np.diag([2.0, 0.5]), 4e3 * np.array([[1.0, -1.0], [-1.0, 1.0]]), [0.01], n_base=1)
    assert np.all(np.isnan(errors_of(other, TRUTH)))


def test_an_undamped_reference_leaves_no_relative_error_of_damping_and_says_so(compared):
    undamped = sysid.Structure(TRUTH.mass, TRUTH.stiffness, [0.0, 0.0], n_base=1)
    np.testing.assert_allclose(errors_of(TRUTH, undamped), [0.0, 0.0, np.nan], atol=1e-9)
    texts = [comparison_text(replace(compared, problem=two_masses(reference=one))) for one in (undamped, TRUTH)]
    assert ["no damping" in " ".join(words.split()) for words in texts] == [True, False]


def test_a_comparison_without_results_is_a_head_without_rows(compared):
    empty = Comparison(two_masses(), 0, None, ())
    assert as_csv(empty).splitlines() == as_csv(compared).splitlines()[:1]
    assert comparison_text(empty).startswith("method ")


def test_what_is_compared_is_the_residual_where_nothing_else_is_minimised(alone):
    assert Comparison(two_masses(), 0, None, ()).quantity == "residual"
    white = np.random.default_rng(0).standard_normal((3, 400))
    records = sysid.Measurement.from_time([(white[:1], white[1:], None)], 50.0, rigid_body=np.ones((2, 1)))
    assert Comparison(sysid.Problem(records), 0, None, ()).quantity == "objective"  # by the noise that is found
    compared = compare(two_masses(noise=0.01), listener=after_the_first)
    assert compared.quantity == "objective"
    assert " residual  " in comparison_text(compared)
    assert "before, after: objective" in comparison_text(compared)


def test_the_table_has_a_line_a_method_and_no_errors_without_a_reference(compared):
    head, *lines = comparison_text(compared).splitlines()
    assert head.split() == ["method", "before", "after", "M,", "%", "K,", "%", "C,", "%", "evaluations", "seconds",
                            "status"]  # fmt: skip
    assert [line.split()[0] for line in lines[:3]] == ["modal", "continuation", "swarm"]
    assert lines[1].split()[1:8] == ["-"] * 7
    assert any(f"continuation: {compared.results[1].message}" in line for line in lines)
    assert max(map(len, (head, *lines))) <= 120
    unknown = Comparison(two_masses(reference=None), 3, None, compared.results)
    assert "%" not in comparison_text(unknown)


def test_rows_go_to_csv_and_strict_json(compared):
    rows = list(csv.DictReader(io.StringIO(as_csv(compared))))
    told = json.loads(strict_json(compared.to_dict()), parse_constant=pytest.fail)
    assert [row["method"] for row in rows] == [row["method"] for row in told["methods"]]
    for row, method, result in zip(rows, told["methods"], compared.results, strict=True):
        assert row["status"] == method["status"] == result.status.value
        assert (float(row["after"]) if result.ran else row["after"]) == (result.after if result.ran else "")
        assert method["after"] == (result.after if result.ran else None)
    assert told["seed"] == 3
    assert told["methods"][2]["phases"][0]["phase"] == "swarm"


def test_a_problem_that_every_strategy_refuses_is_told_with_all_reasons(alone, monkeypatch):
    for strategy in (sysid.Modal, sysid.Continuation, sysid.Swarm):
        monkeypatch.setattr(strategy, "refusal", lambda self, problem, start: f"no {self.name} today")
    told = "no strategy applies: modal: no modal today; continuation: no continuation today; swarm: no swarm today"
    with pytest.raises(sysid.InputError, match=told):
        compare(two_masses())


@pytest.mark.parametrize("at", [0, 1])
def test_an_interrupted_comparison_keeps_what_was_finished(alone, monkeypatch, at):
    heard = []

    def identify(problem, *, strategy, **options):
        if at == 0 or strategy.name == "swarm":
            raise KeyboardInterrupt
        return sysid.identify(problem, strategy=strategy, **options)

    monkeypatch.setattr("sysid.compare.comparison.identify", identify)
    compared = compare(two_masses(), listener=heard.append)
    assert compared.interrupted
    assert [result.name for result in compared.results] == ["modal", "continuation"][: 2 * at]
    assert heard == list(compared.results)


def test_a_method_that_was_interrupted_is_the_last(alone, monkeypatch):
    real = sysid.identify

    def identify(problem, *, callback, **options):
        def stop(progress):
            callback(progress)
            if progress.phase == "swarm" and progress.iteration == 3:
                raise KeyboardInterrupt

        return real(problem, callback=stop, **options)

    monkeypatch.setattr("sysid.compare.comparison.identify", identify)
    compared = compare(two_masses())
    assert compared.interrupted
    assert [result.status for result in compared.results] == [Status.FIT, Status.REFUSED, Status.INTERRUPTED]
    assert len(dict(compared.results[-1].phases)["swarm"]) == 3


def test_a_strategy_that_fails_is_a_row(alone, monkeypatch):
    monkeypatch.setattr(Modal, "run", lambda *given: (_ for _ in ()).throw(sysid.SolverError("nothing came out")))
    (failed,) = compare(two_masses(), listener=after_the_first).results
    assert (failed.status, failed.message) == (Status.FAILED, "nothing came out")
