"""The file of a report: whole or not at all, of a loaded result the same, and small."""

import numpy as np
import pytest

import sysid
from sysid import plot
from sysid.report import report


def test_write_gives_a_file_named_or_in_a_folder(plain, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "render", lambda it: f"residual {it.residual} – \udcff")
    assert report.write_report(plain, tmp_path / "new" / "run.1") == tmp_path / "new" / "run.1" / "report.html"
    path = report.write_report(plain, str(tmp_path / "page.html"))
    assert path.read_text(encoding="utf-8") == f"residual {plain.residual} – ?"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["new", "page.html"]


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_a_failure_while_writing_leaves_the_old_page(plain, tmp_path, monkeypatch, no_pictures, failure):
    (tmp_path / "report.html").write_text("old")

    def fail(*_):
        raise failure("now")

    monkeypatch.setattr(plot, "effective_masses", fail)
    with pytest.raises(failure):
        report.write_report(plain, tmp_path)
    monkeypatch.undo()
    monkeypatch.setattr(report, "render", lambda it: "new")
    monkeypatch.setattr("pathlib.Path.write_bytes", fail)
    with pytest.raises(failure):
        report.write_report(plain, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text() == "old"


def test_a_place_that_cannot_be_written_gets_one_sentence(plain, tmp_path, no_pictures):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(sysid.InputError, match=r"ends in \.html"):
        report.write_report(plain, tmp_path / "notes.txt")
    with pytest.raises(sysid.InputError, match="cannot be written"):
        report.write_report(plain, tmp_path / "notes.txt" / "report.html")
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_report_of_a_loaded_result_is_the_same(complete, tmp_path, monkeypatch):
    """Curve by curve and image by image, without painting them."""

    def told(figure, alt, caption="", *, label="", **_):
        curves = [line.get_xydata().tolist() for ax in figure.axes for line in ax.get_lines()]
        shades = [path.vertices.tolist() for ax in figure.axes for it in ax.collections for path in it.get_paths()]
        images = [np.asarray(image.get_array()).tolist() for ax in figure.axes for image in ax.images]
        bars = [patch.get_bbox().bounds for ax in figure.axes for patch in ax.patches if hasattr(patch, "get_bbox")]
        return f"<p>{label} {alt} {caption} {curves} {shades} {images} {bars}</p>"

    monkeypatch.setattr(report, "picture", told)
    assert report.render(sysid.load(complete.save(tmp_path))) == report.render(complete)


@pytest.mark.slow
def test_a_page_of_12_panels_stays_below_1_megabyte(random_structure, tmp_path):
    """So one of 36 panels stays below 3: what else is on the page does not grow with them."""
    truth = random_structure(np.random.default_rng(1), 12, 1)
    problem = sysid.Problem(
        sysid.simulate(truth, np.geomspace(2, 100, 400), noise=0.02, rng=1),
        mass=sysid.FullMass(),
        stiffness=sysid.SpectralStiffness(truth.natural_frequencies),
    )
    it = sysid.Identification(truth, problem, problem.values(truth), "swarm", 0, sysid.History(), ())
    assert report.write_report(it, tmp_path).stat().st_size < 1e6
