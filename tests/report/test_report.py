"""The report: complete, self-contained and escaped; values stand with what is known of them."""

import base64
import dataclasses
import hashlib
import re
from decimal import Decimal
from html.parser import HTMLParser

import casadi as ca
import numpy as np
import pytest
from scipy.stats import norm

import sysid
from sysid.finding import Finding, Severity
from sysid.report import opening, report
from sysid.report.html import aligned, number, paragraph
from sysid.report.opening import CHOSEN, ONE_OF_MANY, _ranges, noise_of_test, rounded
from sysid.results.summary import residual_in_words

FREQ = np.linspace(1.0, 40.0, 30)
VOID = {"meta", "img", "br", "link"}


class Page(HTMLParser):
    """Reads a page, and insists that each element is closed in its turn."""

    def __init__(self, page):
        super().__init__()
        self.open, self.tags, self.links, self.alts, self.words, self.headings = [], [], [], [], [], []
        self.tables, self.folds = [], []  # of each table its rows of cells, of each fold whether it is open
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href", "data", "action")]
        self.alts += [value for name, value in attrs if name == "alt"]
        assert not [name for name, _ in attrs if name.startswith("on")]
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        elif tag == "small":
            self.tables[-1][-1][-1] += "|"
        elif tag == "details":
            self.folds.append(("open", None) in attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "script":
            return
        self.words.append(data)
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)
        if self.open and self.open[-1] in ("td", "th", "small"):
            self.tables[-1][-1][-1] += data

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def test_the_report_opens_with_the_answer_and_ends_with_the_search(complete, page):
    page = Page(page)
    assert page.headings == [
        "How far to trust it", "Modes", "Mode shapes", "Measured against identified", "Validation", "Total mass",
        "Matrices", "Sensors", "Poles in the data", "Modal assurance criterion", "Effective masses", "How it was found",
    ]  # fmt: skip
    opening, rest = page.text.split("How far to trust it", 1)
    f, percent = complete.structure.natural_frequencies, 100 * complete.structure.damping_ratios
    for words in (
        "One of many", "Next:", "the fit leaves", "noise 1", f"{100 * complete.residual:.3g} % of the accelerations",
        f"unfitted test 1 missed by {100 * complete.problem.validation[0].residual(complete.structure):.3g} %",
        f"mode 1 {f[0]:.2f}", f"damping {percent[0]:.1f}",
    ):  # fmt: skip
        assert words in opening
    for words in (
        "The mass of mode 3 is open.", "The force weighs 2 modes.", "Strategy 'swarm', as asked.",
        "One of many. The search: Solve_Succeeded; damping_ratio[1] ends on its bound",
        f"Relative residual {complete.residual:.3e}", f"Of the base force: {complete.force_residual:.3e}",
        "exploration 7", "777 candidates",
        "swarm over 27 unknowns", "problems/tower.py", "42", sysid.__version__, "Unknowns of the search",
    ):  # fmt: skip
        assert words in rest
    assert rest.index("The mass of mode 3 is open.") < rest.index("Solve_Succeeded")


def test_what_is_open_and_what_speaks_against_the_answer_stand_apart(complete):
    against, left = "the damping is not classical; ratios approximate it", "the mass of mode 3 is open"
    doubtful = complete.with_findings([Finding("damping", Severity.CONTRADICTS, against)])
    told = [part.split("</h3>") for part in opening.trust(doubtful).split("<h3>")[1:]]
    assert [name for name, _ in told] == [
        "What speaks against it", "What the data do not determine", "What no record of this test can show",
    ]  # fmt: skip
    assert against[1:] in told[0][1] and left[1:] not in told[0][1]
    assert left[1:] in told[1][1] and against[1:] not in told[1][1]
    for expected in ((against, "the solver failed"), ("interrupted",)):
        failed = complete.with_findings(Finding("no solution", Severity.CONTRADICTS, one) for one in expected)
        told = dict(part.split("</h3>") for part in opening.trust(failed).split("<h3>")[1:])
        lines = {name: re.findall("<li>(.*?)</li>", content) for name, content in told.items()}
        assert lines["What speaks against it"] == [f"{one[0].upper()}{one[1:]}." for one in expected]
        assert lines["What the data do not determine"] == [f"T{left[1:]}."]


def test_a_model_that_does_not_fit_opens_with_why_and_without_intervals(complete):
    level = noise_of_test(complete.fitted.records, complete.structure)
    reasons = ("are they in Hz?", "it softens", "its gains")
    failed = complete.with_findings(Finding("residual", Severity.CONTRADICTS, one) for one in reasons)
    right, wrong = (opening.opening(it, level) for it in (complete, failed))
    assert "±" in right and "±" not in wrong and "without intervals" in wrong
    assert re.findall("<li>(.*?)</li>", wrong) == ["Are they in Hz?", "It softens."] and "<li>" not in right


def test_the_page_is_self_contained_and_runs_one_script(page):
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)|url\(|@import", page)
    read = Page(page)
    assert not set(read.tags) & {"link", "iframe", "object", "form"}
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page
    for link in read.links:
        if not link.startswith("#"):
            head, data = link.split(",")
            assert head == "data:image/png;base64"
            assert base64.b64decode(data, validate=True).startswith(b"\x89PNG")


def test_hostile_text_is_escaped_and_stays_readable(page, hostile):
    assert "<script>alert" not in page and "<b>done</b>" not in page
    assert hostile in " ".join(Page(page).words)


def test_modes_and_their_reference_are_told(complete, page):
    text = Page(page).text
    ours, theirs, u = complete.structure, complete.problem.reference, complete.uncertainty
    for k in range(3):
        for value in to_two_digits(ours.natural_frequencies[k], u.natural_frequencies[k]):
            assert value in text
        assert f"{theirs.natural_frequencies[k]:.6g}" in text
    assert f"{100 * (np.sqrt(1.02) - 1):+.2g}" in text
    for matrix in (ours.mass, ours.stiffness[:3, :3], ours.damping):
        for value in matrix.ravel():
            assert plain(value) in text


def test_what_is_absent_leaves_no_section(plain, no_pictures):
    page = Page(report.render(plain))
    assert page.headings == [
        "How far to trust it", "Modes", "Mode shapes", "Measured against identified", "Total mass", "Matrices",
        "Poles in the data", "Modal assurance criterion", "Effective masses", "How it was found",
    ]  # fmt: skip
    assert "normalised to 1 kg" in page.text and "convergence" not in page.alts
    assert "No fit" in page.text and all(f"{one.sentence[1:]}." in page.text for one in plain.findings)
    assert "Stopped before its end" in page.text and "AutoMAC" not in page.text
    assert "no reference is known" in page.text


def test_mode_shapes_without_positions_are_a_table(plain, no_pictures):
    page = Page(report.render(plain))
    (shapes,) = [table for table in page.tables if table[0] == ["", "mode 1", "mode 2", "mode 3"]]
    assert [row[0] for row in shapes[1:]] == [*plain.measurement.sensor_names, "base"]
    told = np.array([row[1:] for row in shapes[1:]], float)
    assert not told[-1].any() and np.all(told.max(axis=0) == 1) and np.all(np.abs(told) <= 1)
    for k, shape in enumerate(plain.structure.mode_shapes.T):
        np.testing.assert_allclose(told[:-1, k] * shape[np.argmax(told[:-1, k])], shape, rtol=1e-3)


def test_captions_tell_what_is_in_the_pictures(complete, plain, page, no_pictures):
    assert "Left: poles of models of rising order" in page and "short dashes: each mode of the reference" in page
    assert report._LAST_PHASE not in page and "Errors are those of the reference" in page
    # One run cannot move the base in two directions, so that no FRF and no pole follows.
    test = plain.measurement
    one = dataclasses.replace(test, base=test.base[:1], response=test.response[:1])
    problem = sysid.Problem(one, mass=sysid.FullMass(), stiffness=plain.problem.stiffness)
    other = dataclasses.replace(plain, problem=problem, strategy="continuation")
    assert "Left: the largest singular value; why it is without poles" in report._poles(other)
    assert "rising order" not in report._poles(other)
    assert "dashes" not in report._effective_masses(other)
    assert report._convergence(other) == ""  # no search is told
    searched = dataclasses.replace(other, history=complete.history)
    told = report._convergence(searched)
    assert report._LAST_PHASE in told and "Errors" not in told


def test_a_stated_mass_is_not_called_normalised(page):
    assert "normalised" not in Page(page).text


def test_scores_follow_their_definition(complete, truth, page):
    test = complete.problem.validation[0]
    perfect = report.scores(truth, test)
    np.testing.assert_allclose(perfect.relative, 1, atol=1e-9)
    np.testing.assert_allclose(perfect.absolute, 1, atol=1e-9)
    ours = report.scores(complete.structure, test)
    miss, size = test.predict(complete.structure) - test.relative, test.relative
    with_base = np.einsum("sd,rdf->rsf", test.rigid_body, test.base)
    for s in range(3):
        assert ours.relative[s] == pytest.approx(1 - np.linalg.norm(miss[:, s]) / np.linalg.norm(size[:, s]))
        assert ours.absolute[s] == pytest.approx(1 - np.linalg.norm(miss[:, s]) / np.linalg.norm(test.response[:, s]))
        assert ours.rigid[s] == pytest.approx(
            1 - np.linalg.norm(test.response[:, s] - with_base[:, s]) / np.linalg.norm(test.response[:, s])
        )
    text = Page(page).text
    for name, score in zip(("low", "tip"), ours.relative[[0, 2]], strict=True):
        assert f"{name} {score:.3f}" in text


@pytest.fixture
def modal(truth):
    """Identify `truth` by its modes, with force or without."""

    def identified(force, mass=None, noise=0.01, **changes):
        test = dataclasses.replace(sysid.simulate(truth, 3 * FREQ, noise=noise, force=force, rng=3), **changes)
        return sysid.identify(sysid.Problem(test, mass=mass or sysid.FullMass()), strategy="modal", rng=0)

    return identified


def plain(value, digits=4):
    return f"{float(f'{value + 0.0:.{digits}g}'):.6g}"  # 110, not 1.1e+02


def half(std):
    return plain(norm.ppf(0.975) * std, 2)


def to_two_digits(value, std):
    """A value with the decimals of half of its 95 % interval, and that."""
    places = -Decimal(f"{norm.ppf(0.975) * std:.1e}").as_tuple().exponent
    return [f"{value:.{places}f}", f"{norm.ppf(0.975) * std:.{places}f}"]


def test_what_is_determined_stands_with_half_of_its_95_percent_interval(modal, no_pictures):
    it = modal(force=True, noise=0.001)
    assert it.determined
    tables = Page(report.render(it)).tables
    modes, (rigid, *_) = tables[1], [table for table in tables if table[0] == ["", *it.measurement.base_axes]]
    u, s = it.uncertainty, it.structure
    percent = 100 / np.diag(s.rigid_body_mass)
    for k in range(3):
        cells = modes[k + 1]
        assert cells[1:3] == to_two_digits(s.natural_frequencies[k], u.natural_frequencies[k])
        assert cells[3:5] == to_two_digits(100 * s.damping_ratios[k], 100 * u.damping_ratios[k])
        for i in range(2):
            mass, std = percent[i] * s.effective_masses[k, i, i], percent[i] * u.effective_masses[k, i, i]
            assert cells[5 + i] == f"{mass:.2f}|± {half(std)}"
    assert rigid[1][2] == f"{s.rigid_body_mass[0, 1]:.4g}|± {half(u.rigid_body_mass[0, 1])}"
    names = list(it.measurement.sensor_names)
    square = [table for table in tables if table[0] == ["", *names]]
    M, K = s.mass[:3, :3], s.stiffness[:3, :3]
    for table, values, std in zip(square, (M, K, s.damping), (u.mass, u.stiffness, u.damping), strict=True):
        for name, row, own, wide in zip(names, table[1:], values, std, strict=True):
            assert row == [name, *(f"{plain(v)}|± {half(w)}" for v, w in zip(own, wide, strict=True))]


def test_what_is_not_determined_stands_with_its_range_and_a_mark(modal, truth, no_pictures):
    total = np.diag(truth.rigid_body_mass)
    it = modal(force=False, mass=sysid.FullMass(total, healing="rigid_body"))
    assert not it.determined
    page = Page(report.render(it))
    modes, (rigid, *_) = page.tables[1], [t for t in page.tables if t[0] == ["", *it.measurement.base_axes]]
    assert all(cell.startswith("~") and "±" not in cell for row in modes[1:] for cell in row[5:])
    assert all(float(row[2]) > 0 and float(row[4]) > 0 for row in modes[1:-1])
    assert rigid[1][1:] == [f"{total[0]:.4g}|stated", f"{it.structure.rigid_body_mass[0, 1]:.4g}|open"]
    opening = dict(page.tables[0])
    assert [opening[f"total mass, {axis}"] for axis in "xy"] == [f"{mass:.4g} kg, as stated" for mass in total]
    square = [table for table in page.tables if table[0][1:] == list(it.measurement.sensor_names)]
    assert len(square) == 3
    for table, ends in zip(square, (it.mass_interval, it.stiffness_interval), strict=False):
        for i, j in np.ndindex(3, 3):
            low, high = (plain(end, 3) for end in ends[:, i, j])
            assert table[i + 1][j + 1].split("|")[1:] == [f"{low} to", high]
    assert not any("|" in cell for row in square[2] for cell in row)  # no half-widths about one choice
    assert page.words.count("one of many") == 6  # matrices and their heat maps; pictures are left out here
    assert page.text.count(f"{ONE_OF_MANY} {CHOSEN}") == 2


def test_a_total_mass_that_is_open_is_called_one_of_many(modal, truth, no_pictures):
    it = modal(force=False, mass=sysid.FullMass(np.trace(truth.mass)))
    assert not it.problem.prepared.unit_mass and np.isnan(it.uncertainty.rigid_body_mass).all()
    assert f"{ONE_OF_MANY} Total mass M_rb" in Page(report.render(it)).text


@pytest.mark.parametrize(
    ("value", "told"),
    [(0.8961, "0.896"), (1.0, "1.00"), (123.4, "123"), (0.0, "0"), (1e-7, "1e-07"), (1234.0, "1230"), (np.nan, "–")],
)
def test_numbers_of_a_column_keep_the_zeros_at_their_ends(value, told):
    assert aligned(value) == told


@pytest.mark.parametrize(
    ("value", "told"), [(6e5, "600000"), (561_712.0, "561700"), (-0.0, "0"), (1.234e7, "1.234e+07"), (2e-5, "2e-05")]
)
def test_a_number_has_a_power_of_ten_only_from_a_million_on(value, told):
    assert number(value) == told


@pytest.mark.parametrize(
    ("value", "half", "told"),
    [
        (2471.384, 7.34, ("2471.4", "7.3")),
        (900_446.2, 2251.0, ("900400", "2300")),
        (1.27431e8, 3.1e5, ("1.2743e+08", "3.1e+05")),
        (4.5678e-9, 1.2e-12, ("4.5678e-09", "1.2e-12")),
        (-3e-4, 0.04, ("0.000", "0.040")),
        (99.97, 0.996, ("100.0", "1.0")),
    ],
)
def test_a_value_is_rounded_to_two_digits_of_its_interval(value, half, told):
    assert rounded(value, half / norm.ppf(0.975)) == told


def test_a_range_that_is_one_value_in_three_digits_is_left_to_its_interval():
    otherwise = [[("± 0.1",), ("± 0.2",)], [("± 0.2",), ("± 0.3",)]]
    ends = np.array([[[1.0, -2.0], [-2.0, 3.0]], [[1.0001, 2.0], [2.0, np.inf]]])
    assert _ranges(ends, otherwise) == [[("± 0.1",), ("-2 to", "2")], [("-2 to", "2"), ("from 3",)]]


def test_an_option_of_a_command_stays_on_one_line():
    assert '<span class="option">--leave-out</span> run' in paragraph("'sysid refine RESULT --leave-out run'")


def test_blocks_of_the_base_that_are_zero_are_a_line(written, no_pictures):
    page = Page(report.render(written))  # masses on the sensors alone
    assert "Coupling mass M_S0, kg: zero" in page.text and "Base mass M_00, kg: zero" in page.text


def test_an_entry_without_an_end_is_called_unbounded(modal, no_pictures):
    it = modal(force=False)
    upper = it.mass_interval[1]
    assert np.isinf(upper).all()  # nothing with a unit of mass was given
    square = next(t for t in Page(report.render(it)).tables if t[0][1:] == list(it.measurement.sensor_names))
    for i, j in np.ndindex(3, 3):
        assert square[i + 1][j + 1].split("|")[1:] == (["from 0"] if i == j else ["any value"])


def test_matrices_carry_the_names_of_their_degrees_of_freedom(modal, truth, no_pictures):
    test = sysid.simulate(truth, 3 * FREQ, noise=0.01, force=True, rng=3)
    two = [0, 2]
    it = modal(
        force=True, response=test.response[:, two], rigid_body=test.rigid_body[two], response_std=None,
        sensors=[sysid.Sensor("low", (0, 0, 1), "x"), sysid.Sensor("tip", (0, 0, 1), "y")],
    )  # fmt: skip
    assert it.structure.n == 3
    page = Page(report.render(it))
    names = it.degrees_of_freedom
    assert names[:2] == ("low", "tip") and names[2].startswith("coordinate of mode ")
    assert [table[0][1:] for table in page.tables].count(list(names)) == 3
    assert "3 degrees of freedom from 2 sensors" in page.text
    assert CHOSEN not in page.text  # the force weighs all modes


def test_convergence_tells_only_what_ran(modal, complete, plain, no_pictures):
    def rows(it):
        content = report._convergence(it)
        return [row[:2] for table in Page(content).tables if table[0][0] == "after" for row in table[1:]]

    it = modal(force=False)
    assert rows(it) == [["local phase", f"{it.history.local:.4g}"]]
    assert [name for name, _ in rows(complete)] == ["start", "swarm", "local phase"]
    assert rows(plain) == []


def test_leaders_and_every_status_are_told_on_page_and_in_summary(complete, no_pictures):
    words = (
        "IPOPT refined 12 leaders of the swarm, 5 better than the closed form (Restoration_Failed 1, "
        "Solve_Succeeded 11)"
    )
    assert words in Page(report._convergence(complete)).text
    assert words in " ".join(complete.summary().split())


def test_a_large_structure_is_told_without_what_takes_long(modal, monkeypatch, no_pictures):
    it = modal(force=False)
    monkeypatch.setattr("sysid.results.answer._QUICK_SHAPES", 0)
    monkeypatch.setattr("sysid.results.answer._QUICK_DOFS", 0)
    page = Page(report.render(it))
    assert not {"uncertainty", "_intervals"} & set(vars(it))
    assert page.tables[1][0][1:3] == ["frequency [Hz]", "damping [%]"] and "±" not in page.text
    assert "How far the entries may go is in the result's mass_interval" in page.text


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_what_is_no_fit_at_all_has_its_page(complete, factor, no_pictures):
    truth = complete.problem.reference
    far = sysid.Structure(truth.mass, factor * truth.stiffness, 0 * truth.damping_ratios, n_base=2)
    it = dataclasses.replace(complete, structure=far)
    text = Page(report.render(it)).text
    assert "nan" not in text.lower()
    assert it.summary()


@pytest.fixture
def written(truth):
    """Lumped mass, known stiffness and dampers written in variables, with a further test: where a search could end."""
    c = sysid.Variable("damper", 3, lower=1.0, upper=500.0, unit="N s/m")
    test = sysid.simulate(truth, FREQ, noise=0.01, rng=1)
    C = np.eye(3) @ ca.diag(c)
    further = sysid.FurtherTest(
        dataclasses.replace(test, response=0.9 * test.response), mass=truth.mass, stiffness=truth.stiffness, damping=C
    )
    problem = sysid.Problem(
        test, mass=sysid.LumpedMass([3.0, 4.0]), stiffness=truth.stiffness, damping=C, residuals=[further]
    )
    x = np.array([0.3, 0.6, 0.9, 20.0, 500.0, 40.0])
    return sysid.Identification(problem.structure(x), problem, x, "continuation", 0, sysid.History(), ())


def test_unknowns_stand_with_units_and_mark_the_bound_that_they_rest_on(written, no_pictures):
    page = Page(report.render(written))
    opening = dict(page.tables[0])
    assert opening["damper[1]"].startswith("500") and opening["damper[1]"].endswith(" N s/m")
    (rows,) = [table[1:] for table in page.tables if table[0][0] == "unknown"]
    assert [row[:2] + row[3:] for row in rows] == [
        ["damper[0]", "20", "N s/m", "1", "500", ""],
        ["damper[1]", "500", "N s/m", "1", "500", "on its upper bound"],
        ["damper[2]", "40", "N s/m", "1", "500", ""],
    ]
    std = written.uncertainty.variables["damper"]
    assert [row[2] for row in rows] == [half(value) for value in std]


def test_residual_and_objective_of_all_tests_stand_on_top(written, no_pictures):
    page = Page(report.render(written))
    top = page.text[: page.text.index("Unknowns of the search")]
    own, second = written.residuals
    assert f"Relative residual {residual_in_words(written)}" in top
    assert re.findall(r"[\d.]+e[+-]\d+|\d+", residual_in_words(written)) == [
        f"{written.residual:.3e}", "2", f"{own:.3e}", f"{second:.3e}"
    ]  # fmt: skip
    assert page.tables[0][-1][1].startswith(f"{100 * written.residual:.3g} % ")
    assert f"Objective {written.objective:.3e}" in top
    assert f"Relative residual {second:.4g};" in page.text


def test_what_each_matrix_was_stated_to_be_is_told(written, complete, no_pictures):
    rows = [dict(Page(report._what_ran(it)).tables[0]) for it in (complete, written)]
    assert [row["mass model"].split("; ") for row in rows] == [
        ["FullMass", "total of the diagonal"],
        ["LumpedMass", "total on the sensors", "the mass is stated to be lumped on the sensors, with its total given"],
    ]
    assert [row["stiffness model"] for row in rows] == ["SpectralStiffness", "numbers"]
    assert [row["damping model"] for row in rows] == ["ModalDamping", "written in variables"]


def test_a_misfit_of_the_users_is_named_as_what_was_fitted(written, no_pictures):
    c = sysid.Variable("damper", 3, lower=1.0, upper=500.0)
    problem = sysid.Problem(
        written.measurement, mass=written.problem.mass, stiffness=written.problem.stiffness, damping=ca.diag(c),
        misfit=c / 100 - 1,
    )  # fmt: skip
    own = dataclasses.replace(written, problem=problem)
    assert "of the misfit that the problem states" in report._how(own) and "misfit" not in report._how(written)
