"""The summary for a terminal, and the figures of summary.json."""

import dataclasses
import json
import re

import numpy as np
import pytest
from scipy.stats import norm

import sysid
from sysid.export.content import Content, statements
from sysid.finding import Finding, Severity
from sysid.results.summary import next_steps, verdict

FREQ = np.linspace(3.0, 120.0, 60)


@pytest.fixture
def truth(random_structure):
    return random_structure(np.random.default_rng(8), 3, 2, G=np.array([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]]))


@pytest.fixture
def modal(truth):
    """Identify `truth` by its modes, with force or without."""

    def identified(force, mass=None, noise=0.01, **changes):
        test = dataclasses.replace(sysid.simulate(truth, FREQ, noise=noise, force=force, rng=3), **changes)
        return sysid.identify(sysid.Problem(test, mass=mass or sysid.FullMass()), strategy="modal", rng=0)

    return identified


def rows(it):
    """Cells of the table of modes."""
    table = it.summary().split("\n+- half")[0].split("\n\n")[-1]
    return [line.split() for line in table.splitlines()]


def rigid_masses(it):
    """Direction, mark of one of many, value and half-width of each rigid-body mass in the summary."""
    (line,) = [line for line in it.summary().splitlines() if line.startswith("rigid-body mass")]
    return re.findall(r"(\w+) (~?)([\d.]+)(?: \+- (\S+))? kg", line)


def ranges(it):
    """Ranges of the diagonal entries in the summary, as multiples: least and most of M_SS and of K_SS."""
    told = " ".join(it.summary().split()).partition("diagonal entries")[2].partition("assumed:")[0]
    return {matrix: (least, most) for least, most, matrix in re.findall(r"(\S+) to (\S+) .*?(M_SS|K_SS)", told)}


def half(std):
    return f"{norm.ppf(0.975) * std:.2g}"


def test_the_table_of_modes_has_half_of_each_95_percent_interval(modal):
    it = modal(force=True)
    u, s = it.uncertainty, it.structure
    percent = 100 / np.diag(s.rigid_body_mass)
    for k, row in enumerate(rows(it)[1:4]):
        assert row[::2][:2] == [str(k + 1), half(u.natural_frequencies[k])]
        assert abs(float(row[1]) - s.natural_frequencies[k]) < 0.051 * float(row[2])  # to the digits of its interval
        assert row[3:5] == [f"{100 * s.damping_ratios[k]:.4g}", half(100 * u.damping_ratios[k])]
        for i in range(2):
            mass, std = percent[i] * s.effective_masses[k, i, i], percent[i] * u.effective_masses[k, i, i]
            assert row[5 + 2 * i : 7 + 2 * i] == [f"{mass:.1f}", half(std)]
    assert "~" not in it.summary()
    masses, std = np.diag(s.rigid_body_mass), np.diag(u.rigid_body_mass)
    assert rigid_masses(it) == [("xy"[i], "", f"{masses[i]:.6g}", half(std[i])) for i in range(2)]


def test_no_noise_leaves_a_half_width_of_zero(modal):
    for row in rows(modal(force=True, noise=0.0))[1:4]:
        assert [row[2], row[4], row[6], row[8]] == ["0"] * 4


def test_masses_that_are_one_choice_are_marked_and_their_range_is_told(modal, truth):
    it = modal(force=False, mass=sysid.FullMass(np.diag(truth.rigid_body_mass), healing="rigid_body"))
    assert all(cell.startswith("~") for row in rows(it)[1:4] for cell in row[5:])
    told = {}
    for name, matrix, (lower, upper) in (
        ("M_SS", it.structure.mass[:3, :3], it.mass_interval),
        ("K_SS", it.structure.stiffness[:3, :3], it.stiffness_interval),
    ):
        share = np.array([np.diag(end) / np.diag(matrix) for end in (lower, upper)])
        told[name] = f"{abs(share.min()):.3g}", f"{share.max():.3g}"
    assert ranges(it) == told


def test_ranges_that_would_take_time_are_not_computed_and_the_summary_says_so(modal, monkeypatch):
    monkeypatch.setattr("sysid.results.answer._DOFS_AT_ONCE", 2)
    it = modal(force=False)
    text = it.summary()
    assert "_intervals" not in vars(it) and "Identification.mass_interval" in text and not ranges(it)
    assert it.mass_interval.shape == (2, 3, 3)
    assert set(ranges(it)) == {"M_SS", "K_SS"} and "Identification.mass_interval" not in it.summary()


def test_a_range_without_an_end_is_no_number(modal):
    it = modal(force=False)
    assert ranges(it)["M_SS"] == ("0", "any") and "inf" not in it.summary()


def test_no_line_is_wider_than_120_columns(random_structure):
    wide = random_structure(np.random.default_rng(1), 4, 6, frequencies=[5.0, 9.0, 14.0, 22.0])
    for force in (True, False):
        test = sysid.simulate(wide, np.linspace(2, 30, 80), noise=0.01, force=force, rng=2)
        it = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), strategy="modal", rng=0)
        it = it.with_findings([Finding("search", Severity.NOTE, "remark " * 40)])
        assert max(map(len, it.summary().splitlines())) <= 120
        assert all(str(note).strip() in " ".join(it.summary().split()) for note in it.notes)


def test_degrees_of_freedom_are_sensors_or_modal_coordinates(modal, truth):
    it = modal(force=True)
    assert it.degrees_of_freedom == it.measurement.sensor_names == ("sensor 1", "sensor 2", "sensor 3")
    # Another choice of coordinates for the same structure: a sensor and two modal coordinates, then a mixture.
    one, phi = np.eye(3), truth.normal_modes
    mixed = np.linalg.inv(np.column_stack([one[1], phi[:, 0], phi[:, 2]]))  # modes 1 and 3 leave the first at rest
    for rows_of, names in (
        (np.linalg.inv(phi), ("coordinate of mode 1", "coordinate of mode 2", "coordinate of mode 3")),
        (np.vstack([one[1], np.linalg.inv(phi)[[0, 2]]]), ("sensor 2", "coordinate of mode 1", "coordinate of mode 3")),
        (mixed, ("coordinate of mode 2", "coordinate 2", "coordinate 3")),
    ):
        back = np.linalg.inv(rows_of)
        full = np.block([[back, np.zeros((3, 2))], [np.zeros((2, 3)), np.eye(2)]])
        turned = sysid.Structure(
            full.T @ truth.mass @ full, full.T @ truth.stiffness @ full, truth.damping_ratios, n_base=2,
            recovery=back, rigid_body=truth.rigid_body,
        )  # fmt: skip
        np.testing.assert_allclose(turned.transmissibility(FREQ), truth.transmissibility(FREQ), rtol=1e-8, atol=1e-8)
        assert dataclasses.replace(it, structure=turned).degrees_of_freedom == names


def test_what_takes_long_is_asked_for_only_where_it_is_known(modal, monkeypatch):
    it = modal(force=False)
    monkeypatch.setattr("sysid.results.answer._QUICK_SHAPES", 0)
    monkeypatch.setattr("sysid.results.answer._QUICK_DOFS", 0)
    monkeypatch.setattr("sysid.results.answer._DOFS_AT_ONCE", 0)
    assert it.quick_uncertainty is None and it.quick_intervals is None
    assert "+-" not in it.summary() and "diagonal entries" not in it.summary()
    assert it.to_dict()["natural_frequencies_std_hz"] == [None] * 3
    known, ends = it.uncertainty, it.mass_interval
    assert it.quick_uncertainty is known and it.quick_intervals.mass is ends
    assert "+-" in it.summary() and "diagonal entries" in it.summary()


def test_the_figures_are_json_with_null_for_what_is_open(modal, truth):
    it = modal(force=False)
    figures = json.loads(json.dumps(it.to_dict(), allow_nan=False))
    assert figures["natural_frequencies_std_hz"] == it.uncertainty.natural_frequencies.tolist()
    assert figures["damping_ratios_std"] == it.uncertainty.damping_ratios.tolist()
    assert [one["kind"] for one in figures["findings"]] == [one.kind for one in it.findings]
    assert figures["confidence"] == list(it.confidence)
    # A mode with no momentum along any base direction answers nothing.
    phi = truth.normal_modes
    blind = truth.mass.copy()
    push = blind[:3, :3] @ truth.rigid_body + blind[:3, 3:]
    push -= np.outer(blind[:3, :3] @ phi[:, 1], phi[:, 1] @ push)
    blind[:3, 3:] = push - blind[:3, :3] @ truth.rigid_body
    blind[3:, :3] = blind[:3, 3:].T
    blind[3:, 3:] += 100 * np.eye(2)
    unseen = sysid.Structure(blind, truth.stiffness, truth.damping_ratios, n_base=2)
    test = sysid.simulate(unseen, FREQ, noise=0.01, rng=1)
    problem = sysid.Problem(test, mass=sysid.FullMass())
    it = dataclasses.replace(it, structure=unseen, problem=problem)
    std = it.to_dict()["natural_frequencies_std_hz"]
    assert [value is None for value in std] == [False, True, False]
    assert rows(it)[2][2::2][:2] == ["open", "open"]


def test_the_judgement_stands_first_with_what_speaks_against_it_and_the_next_step(modal):
    it = modal(force=True)
    assert it.summary().startswith(f"Determined: {verdict(it)}.\n  - ")
    against = ("the structure softens", "the model misses the records", "a gain is wrong")
    kinds = ("changing", "beyond noise", "gain")
    contradict = [Finding(kind, Severity.CONTRADICTS, told) for kind, told in zip(kinds, against, strict=True)]
    failed = it.with_findings([*contradict, Finding("open", Severity.CAUTION, "mode 2 is open")])
    lines = failed.summary().splitlines()
    assert lines[0] == f"No fit: {verdict(failed)}. Fitted: 2 runs."
    assert [line[4:] for line in lines[1:3]] == list(against[:2]) and lines[3].startswith("  > ")
    first, *_ = next_steps(failed)  # of records whose frequencies change
    assert "one.h5" in first and first in " ".join(failed.summary().split())
    besides = lines[lines.index("besides:") :]
    assert [line[4:] for line in besides[1:3]] == ["a gain is wrong", "mode 2 is open"]
    assert besides[-1] == f"search: {it.message}" and it.message
    assert not ranges(failed)  # of models that explain the data
    notes = [line for one in (it, failed) for line in one.summary().splitlines() if line.startswith("+- half")]
    assert ["does not;" in note for note in notes] == [False, True]  # intervals hold for a model that fits
    goal = np.ceil(100 * it.residual) / 100
    assert f" goal={goal:.2g} " in failed.summary() and f" --goal {goal:.2g})" in failed.summary()
    assert it.with_findings([contradict[2]]).summary().startswith("Doubtful: a fit, but ")


def test_masses_without_a_unit_are_marked_and_a_gain_moves_none_of_them(modal):
    it = modal(force=False)
    assert it.problem.prepared.unit_mass
    assert [masses[:3] for masses in rigid_masses(it)] == [
        (axis, "~", f"{mass:.6g}") for axis, mass in zip("xy", np.diag(it.structure.rigid_body_mass), strict=True)
    ]
    assert np.isnan(it.gain_worth).all()
    (head,) = [i for i, line in enumerate(it.summary().splitlines()) if line.startswith("gain against the base")]
    assert [line.split()[-1] for line in it.summary().splitlines()[head + 1 : head + 4]] == ["-"] * 3


@pytest.mark.parametrize("mass", [sysid.LumpedMass(), sysid.FullMass()])
def test_masses_of_a_lumped_model_are_told_and_what_no_mode_moves(mass):
    ring = 0.0 if isinstance(mass, sysid.LumpedMass) else 1.0  # kg that move with the base, beside 5 on springs
    M, K = np.diag([3.0, 2.0, ring]), np.array([[9e4, -4e4, -5e4], [-4e4, 4e4, 0], [-5e4, 0, 5e4]])
    test = sysid.simulate(sysid.Structure(M, K, [0.01, 0.02], n_base=1), FREQ, noise=0.01, force=True, rng=1)
    it = sysid.identify(sysid.Problem(test, mass=mass), rng=0)
    text, std = " ".join(it.summary().split()), np.diag(it.uncertainty.mass)
    told = [f"sensor {i + 1} {it.structure.mass[i, i]:.5g} +- {half(std[i])} kg" for i in range(2)]
    assert (f"M_SS): {', '.join(told)}" in text) is (ring == 0)
    missing = re.findall("of the rigid-body mass, (.*?) % in x is in none of these modes", text)
    np.testing.assert_allclose([float(share) for share in missing], [100 / 6] * bool(ring), rtol=0.03)


def test_one_open_factor_is_closed_by_a_total_and_what_a_total_takes_for_granted_is_told():
    M, K = np.diag([2.0, 1.0, 0.0]), np.array([[3900.0, -1500, -2400], [-1500, 1500, 0], [-2400, 0, 2400]])
    truth, lines = sysid.Structure(M, K, np.array([0.01, 0.02]), n_base=1), np.linspace(1, 12, 200)
    test = sysid.simulate(truth, lines, noise=0.01, rng=0)
    scale, every, stated = (
        sysid.identify(sysid.Problem(test, mass=mass), rng=0)
        for mass in (sysid.LumpedMass(), sysid.FullMass(), sysid.LumpedMass(3.0))
    )
    assert scale.scale_is_open and not every.scale_is_open and not stated.scale_is_open
    assert "common factor" in scale.summary() and not ranges(scale)
    assert ranges(every)["M_SS"] == ("0", "any")
    (granted,) = [one for one in stated.assumptions if one.kind == "assumed total"]
    assert stated.determined and "3 kg" in granted.sentence
    forced = sysid.simulate(truth, lines, noise=0.01, force=True, rng=0)
    weighed = sysid.identify(sysid.Problem(forced, mass=sysid.LumpedMass(4.0)), rng=0)
    against = weighed.findings[0]
    assert against.kind == "stated mass" and against.numbers["stated 1"] == pytest.approx(4.0)
    assert against.numbers["weighed 1"] == pytest.approx(3.0, rel=0.1)  # by the modes of a model with 4 kg
    assert not [one for one in weighed.assumptions if one.kind == "assumed total"]


def test_what_is_determined_without_a_force_is_told_to_rest_on_what_is_stated():
    """All matrices twice as large make the same accelerations: what is stated alone tells them apart."""
    M, K = np.diag([2.0, 1.0, 0.0]), np.array([[3900.0, -1500, -2400], [-1500, 1500, 0], [-2400, 0, 2400]])
    truth, lines = sysid.Structure(M, K, np.array([0.01, 0.02]), n_base=1), np.linspace(1, 12, 200)
    test, forced = (sysid.simulate(truth, lines, noise=0.01, force=force, rng=0) for force in (False, True))
    right, twice, of_force = (
        sysid.identify(sysid.Problem(records, mass=mass), rng=0)
        for records, mass in (
            (test, sysid.LumpedMass(3.0)),
            (test, sysid.LumpedMass(6.0)),
            (forced, sysid.LumpedMass()),
        )
    )
    np.testing.assert_allclose(twice.structure.stiffness, 2 * right.structure.stiffness, rtol=1e-6, atol=1e-6)
    unforced, assumed = "No force was measured: they are as right as", "assumed: all of the stated 6 kg"
    assert right.determined and unforced in verdict(right)
    assert twice.determined and unforced in verdict(twice)
    assert of_force.determined and unforced not in verdict(of_force)
    further = sysid.FurtherTest(forced, mass=M, stiffness=K[:2, :2], damping=np.eye(2))
    both = sysid.Problem(test, mass=sysid.LumpedMass(3.0), residuals=[further])
    assert unforced not in verdict(dataclasses.replace(right, problem=both))
    assert any(told.startswith(assumed) for told in statements(Content.of(twice), ""))
    assert not any(told.startswith(assumed) for told in statements(Content.of(of_force), ""))


@pytest.mark.parametrize(("mass", "scale"), [(sysid.LumpedMass(), True), (sysid.FullMass(), False)])
def test_the_step_that_closes_a_common_factor_is_one_number_in_kg(random_case, mass, scale):
    """Effective masses in %, of which a common factor makes nothing, are then known."""
    _, problem = random_case(np.random.default_rng(5), "lumped", n=3, d=1, total=False)
    it = sysid.identify(dataclasses.replace(problem, mass=mass), strategy="modal")
    (step,) = next_steps(it)
    assert it.scale_is_open is scale and step in " ".join(it.summary().split())
    assert ("one number" in step, "total mass" in step) == (scale, not scale)
    assert any("~" in cell for row in rows(it)[1:4] for cell in row) is not scale
