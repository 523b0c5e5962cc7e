"""The report: complete, self-contained, escaped, and whole or not at all."""

import base64
import dataclasses
import re
from html.parser import HTMLParser

import numpy as np
import pytest

import sysid
from sysid import plot, report

FREQ = np.linspace(1.0, 40.0, 30)
HOSTILE = "</td><script>alert('x')</script> & \"$\\foo$\""
VOID = {"meta", "img", "br", "link"}


class Page(HTMLParser):
    """Reads a page, and insists that each element is closed in its turn."""

    def __init__(self, page):
        super().__init__()
        self.open, self.tags, self.links, self.alts, self.words, self.headings = [], [], [], [], [], []
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href", "data", "action")]
        self.alts += [value for name, value in attrs if name == "alt"]
        assert not [name for name, _ in attrs if name.startswith("on")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


@pytest.fixture
def truth(random_structure):
    return random_structure(np.random.default_rng(8), 3, 2, G=np.array([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]]))


@pytest.fixture
def complete(truth):
    """Unit runs with force, reference and a validation of two runs in which everything moves."""
    random = np.random.default_rng(4)
    guess = sysid.Structure(truth.mass, 1.02 * truth.stiffness, truth.damping_ratios, n_base=2)
    names = ("low", HOSTILE, "tip")
    sensors = [sysid.Sensor(name, (0, 0, float(i)), "x") for i, name in enumerate(names)]
    test = dataclasses.replace(sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=3), sensors=sensors)
    base = random.standard_normal((2, 2, FREQ.size)) + 1j * random.standard_normal((2, 2, FREQ.size))
    response = np.einsum("sdf,rdf->rsf", truth.transmissibility(FREQ), base)
    unseen = sysid.Measurement(FREQ, base, response, rigid_body=truth.rigid_body, sensors=sensors)
    problem = sysid.Problem(
        test,
        mass=sysid.FullMass(np.diag(truth.rigid_body_mass)),
        stiffness=sysid.SpectralStiffness(truth.natural_frequencies),
        reference=truth,
        validation=[unseen],
        goal=0.5,
    )
    history = sysid.History(
        0.9,
        0.5,
        0.4,
        0.01,
        np.array([0.9, 0.5]),
        np.array([0.4, 0.01]),
        1e-11,
        (("exploration", 7),),
        777,
        1.5,
        ("0.00 s  swarm over 27 unknowns", "<b>done</b>"),
    )
    return sysid.Identification(
        guess, problem, problem.values(guess), "swarm", 42, True, "Solve_Succeeded; damping_ratio[1] ends on its bound",
        history, False, ("the force weighs 2 modes",), ("the mass of mode 3 is open",), False,
        sysid.Recipe("problems/tower.py", "data/x", 1),
    )  # fmt: skip


PAGES = {}  # a page takes seconds, and the same result gives the same page


@pytest.fixture
def page(complete):
    """The page of `complete`."""
    if "complete" not in PAGES:
        PAGES["complete"] = report.render(complete)
    return PAGES["complete"]


@pytest.fixture
def plain(truth):
    """No reference, no validation, no force, no names, no search, no unit of mass."""
    problem = sysid.Problem(
        sysid.simulate(truth, FREQ),
        mass=sysid.FullMass(),
        stiffness=sysid.SpectralStiffness(truth.natural_frequencies),
    )
    return sysid.Identification(
        truth, problem, problem.values(truth), "swarm", None, False, "interrupted", sysid.History(), True,
        ("the mass matrix is known",), (), True,
    )  # fmt: skip


def test_the_report_has_every_part_in_order(complete, page):
    page = Page(page)
    assert page.headings == [
        "Modes", "Rigid-body mass", "Measured against identified", "Base force", "Validation", "Convergence",
        "Modal assurance criterion", "Effective masses", "Mode shapes", "Matrices", "What ran",
    ]  # fmt: skip
    assert page.text.index("Solve_Succeeded; damping_ratio[1] ends on its bound") < page.text.index("Modes")
    for words in (
        "Success", f"Relative residual {complete.residual:.3e}", f"Of the base force: {complete.force_residual:.3e}",
        "one of many models that explain the data", "The mass of mode 3 is open.", "The force weighs 2 modes.",
        "exploration 7", "777 candidates", "swarm over 27 unknowns", "problems/tower.py", "42", sysid.__version__,
        "Unknowns of the search",
    ):  # fmt: skip
        assert words in page.text


def test_every_sensor_of_every_test_has_its_picture(complete, page):
    page = Page(page)
    for sensor in complete.measurement.sensor_names:
        assert f"{sensor}: measured and identified response, base x, base y" in page.alts
        assert f"{sensor}: measured and identified response, run 1, run 2" in page.alts
    assert [alt for alt in page.alts if "base force" in alt] == [
        "measured and identified base force, base x",
        "measured and identified base force, base y",
    ]
    assert page.tags.count("img") == 6 + 2 + 5


def test_the_page_is_self_contained_and_runs_nothing(page):
    assert not re.search(r"https?://|url\(|@import", page)
    read = Page(page)
    assert not set(read.tags) & {"script", "link", "iframe", "object", "form"}
    for link in read.links:
        if not link.startswith("#"):
            head, data = link.split(",")
            assert head == "data:image/png;base64"
            assert base64.b64decode(data, validate=True).startswith(b"\x89PNG")


def test_hostile_text_is_escaped_and_stays_readable(page):
    assert "<script>alert" not in page and "<b>done</b>" not in page
    assert HOSTILE in " ".join(Page(page).words)


def test_modes_and_their_reference_are_told(complete, page):
    text = Page(page).text
    ours, theirs = complete.structure, complete.problem.reference
    for k in range(3):
        assert f"{ours.natural_frequencies[k]:.6g}" in text and f"{theirs.natural_frequencies[k]:.6g}" in text
    assert f"{100 * (np.sqrt(1.02) - 1):+.2g}" in text
    for matrix in (ours.mass, ours.stiffness[:3, :3], ours.damping):
        for value in matrix.ravel():
            assert f"{value:.4g}" in text


def test_what_is_absent_leaves_no_section(plain):
    page = Page(report.render(plain))
    assert page.headings == [
        "Modes", "Rigid-body mass", "Measured against identified", "Convergence", "Modal assurance criterion",
        "Effective masses", "Matrices", "What ran",
    ]  # fmt: skip
    assert "normalised to 1 kg" in page.text
    assert "Determined: this is the mass and stiffness" in page.text and "The mass matrix is known." in page.text
    assert "Interrupted" in page.text and "AutoMAC" not in page.text and "no reference is known" in page.text


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


def test_write_gives_a_file_named_or_in_a_folder(plain, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "render", lambda it: f"residual {it.residual} – \udcff")
    assert report.write(plain, tmp_path / "new" / "run.1") == tmp_path / "new" / "run.1" / "report.html"
    path = report.write(plain, str(tmp_path / "page.html"))
    assert path.read_text(encoding="utf-8") == f"residual {plain.residual} – ?"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["new", "page.html"]


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_a_failure_while_writing_leaves_the_old_page(plain, tmp_path, monkeypatch, failure):
    (tmp_path / "report.html").write_text("old")

    def fail(*_):
        raise failure("now")

    monkeypatch.setattr(plot, "effective_masses", fail)
    with pytest.raises(failure):
        report.write(plain, tmp_path)
    monkeypatch.undo()
    monkeypatch.setattr("pathlib.Path.write_bytes", fail)
    with pytest.raises(failure):
        report.write(plain, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text() == "old"


def test_a_place_that_cannot_be_written_gets_one_sentence(plain, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(sysid.InputError, match=r"ends in \.html"):
        report.write(plain, tmp_path / "notes.txt")
    with pytest.raises(sysid.InputError, match="cannot be written"):
        report.write(plain, tmp_path / "notes.txt" / "report.html")
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_report_of_a_loaded_result_is_the_same(complete, page, tmp_path):
    assert report.render(sysid.load(complete.save(tmp_path))) == page


@pytest.mark.slow
def test_a_page_of_36_panels_stays_below_3_megabytes(random_structure, tmp_path):
    truth = random_structure(np.random.default_rng(1), 12, 3)
    problem = sysid.Problem(
        sysid.simulate(truth, np.geomspace(2, 100, 400), noise=0.02, rng=1),
        mass=sysid.FullMass(),
        stiffness=sysid.SpectralStiffness(truth.natural_frequencies),
    )
    it = sysid.Identification(
        truth, problem, problem.values(truth), "swarm", 0, True, "", sysid.History(), False, (), ()
    )
    assert report.write(it, tmp_path).stat().st_size < 3e6
