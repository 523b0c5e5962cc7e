"""An answer in the band beside what is beyond it: residual modes, masses in none of the modes, lines that follow."""

import dataclasses
import re

import numpy as np
import pytest

import sysid
from sysid import catalogue
from sysid.report import report
from sysid.results import tables


@pytest.fixture(scope="module")
def answer():
    """Four modes of a cantilever in the lines; the truth, at lines up to twice the last, is never fitted."""
    mast = catalogue._load("cantilever_in_band")[0].mast()
    problem = catalogue.build(sysid.Recipe("cantilever_in_band"))
    freq = np.linspace(0.8, 2, 300) * problem.measurement.freq[-1]
    unseen = sysid.simulate(mast, freq, force=True)
    return sysid.identify(dataclasses.replace(problem, validation=[unseen]), rng=0)


def test_what_the_fit_leaves_and_what_residual_modes_add_are_told_of_each_channel(answer):
    s, test = answer.structure, answer.fitted.records
    none = sysid.Structure(
        s.mass, s.stiffness, s.damping_ratios, n_base=2, rigid_body=s.rigid_body, recovery=s.recovery
    )  # fmt: skip
    rows = tables.fit_of_channels(answer)
    assert [row.channel for row in rows] == [*test.sensor_names, "base force x", "base force y"]
    norm = lambda part: np.linalg.norm(part, axis=(0, 2))  # noqa: E731
    left = np.append(
        norm(test.predict(s) - test.relative) / norm(test.relative),
        norm(test.predict_force(s) - test.force) / norm(test.force),
    )
    np.testing.assert_allclose([row.left for row in rows], left, rtol=1e-10)
    added = norm(test.predict(s) - test.predict(none)) / norm(test.relative)
    np.testing.assert_allclose([row.beyond for row in rows[: s.n_sensors]], added, rtol=1e-8)
    # Without its residual modes the structure has their mass no more.
    rigid = np.einsum("de,ref->rdf", s.rigid_body_mass - none.rigid_body_mass, test.base)
    pull = test.predict_force(s) - test.predict_force(none) - rigid
    np.testing.assert_allclose([row.beyond for row in rows[s.n_sensors :]], norm(pull) / norm(test.force), rtol=1e-8)
    at, share = re.search(r"of the response, most at (.*): (\S+) %", answer.summary()).groups()
    assert at == test.sensor_names[int(np.argmax(added))] and float(share) == pytest.approx(100 * added.max(), rel=0.05)


def test_masses_of_the_modes_stand_beside_the_rigid_body_mass(answer):
    s = answer.structure
    rows = tables.masses_of_modes(answer)
    assert [(row.axis, row.unit, row.one_of_many) for row in rows] == [("x", "kg", False), ("y", "kg", False)]
    np.testing.assert_allclose([row.rigid_body for row in rows], np.diag(s.rigid_body_mass))
    np.testing.assert_allclose([row.in_modes for row in rows], np.sum(s.participation**2, axis=0))
    told = re.findall(r"kg \((\S+) kg", " ".join(answer.summary().split()))
    assert told == [f"{row.in_modes:.4g}" for row in rows]


def test_a_test_that_was_not_fitted_says_how_many_of_its_lines_are_beyond(answer):
    (unseen,) = answer.validation
    last = answer.measurement.freq[-1]
    beyond = unseen.freq > last + np.diff(unseen.freq)[0]
    told = " ".join(answer.summary().split())
    count, lines, within, outside = re.search(
        r"; (\d+) of its (\d+) lines are beyond those .* missed by (\S+) % within, (\S+) % beyond", told
    ).groups()
    assert (int(count), int(lines)) == (np.count_nonzero(beyond), unseen.freq.size)
    for figure, part in ((within, ~beyond), (outside, beyond)):
        assert float(figure) == pytest.approx(100 * unseen.at(part).residual(answer.structure), rel=0.01)
    assert tables.beyond_lines(answer, unseen.in_band(0.0, last)) == ""
    assert "missed" not in tables.beyond_lines(answer, unseen.in_band(1.1 * last, 2 * last))


def test_lines_beyond_speak_against_no_answer_in_the_band(answer):
    (unseen,) = answer.validation
    assert unseen.residual(answer.structure) > 1.0  # the fifth and sixth mode are missed
    assert not answer.of_kind("unpredicted") and answer.judgement == "determined"


def test_the_page_holds_all_of_it(answer, no_pictures):
    page = report.render(answer)
    row = tables.masses_of_modes(answer)[1]
    assert re.search(rf"<td>y</td>.*?{row.rigid_body:.4g}.*?{row.in_modes:.4g}", page, re.DOTALL)
    assert "modes beyond" in page and "of its 300" in page


def test_leaving_runs_out_is_proposed_where_the_others_move_the_base_as_all_do(answer):
    """Each of two runs moves the base in a direction of its own; a third in both makes one of them spare."""
    assert not tables.runs_can_be_left_out(answer)
    assert "--leave-out" not in report.render(dataclasses.replace(answer, problem=without_validation(answer.problem)))
    test = answer.measurement
    more = [np.concatenate([part, part.sum(axis=0, keepdims=True)]) for part in (test.base, test.response, test.force)]
    three = sysid.Measurement(test.freq, *more[:2], force=more[2], sensors=test.sensors, rigid_body=test.rigid_body)
    problem = dataclasses.replace(without_validation(answer.problem), measurement=three)
    assert tables.runs_can_be_left_out(dataclasses.replace(answer, problem=problem))


def without_validation(problem):
    return dataclasses.replace(problem, validation=())
