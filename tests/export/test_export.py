"""Exported files keep the numbers, say what is open, and are written whole or not at all."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from scipy.io import loadmat

import sysid
from sysid.cli.main import main
from sysid.export.content import damping_of


def test_a_table_keeps_every_number_and_tells_units_and_judgement(result, tmp_path):
    lines = sysid.export(result, tmp_path / "new" / "m.csv").read_text(encoding="utf-8").splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    s = result.structure
    for letter, matrix in (("M", s.mass), ("K", s.stiffness), ("C", damping_of(s))):
        read = np.zeros((5, 5))
        for row in (r for r in rows if r["matrix"] == letter):
            read[int(row["row"]) - 1, int(row["column"]) - 1] = float(row["value"])
        assert np.array_equal(read, matrix)
    assert {r["unit"] for r in rows} == {f"{u}{m}" for u in ("kg",) for m in ("", " m", " m2")} | {
        "N/m",
        "N",
        "N m",
        "N s/m",
        "N s",
        "N s m",
    }
    assert rows[3]["column_name"] == "base x" and rows[3]["row_name"] == "floor 1"
    head = "\n".join(line for line in lines if line.startswith("#"))
    assert "judgement: " in head and "units: " in head and sysid.__version__ in head


def test_a_matlab_file_keeps_every_number(result, tmp_path):
    read = loadmat(sysid.export(result, tmp_path / "m.mat"))
    s, system = result.structure, result.structure.to_state_space()
    for name, value in {"M": s.mass, "K": s.stiffness, "Phi": s.mode_shapes, "G": s.rigid_body, "A": system.A}.items():
        assert np.array_equal(read[name], value), name
    assert [str(cell[0]) for cell in read["dof_names"][:, 0]] == ["floor 1", "floor 2", "floor 3", "base x", "base ry"]
    assert any(str(cell[0]).startswith("judgement: ") for cell in read["about"][:, 0])


def test_damping_on_all_degrees_of_freedom_is_still_in_a_rigid_motion(result):
    s = result.structure
    rigid = np.vstack([s.rigid_body_dofs, np.eye(2)])
    assert np.abs(damping_of(s) @ rigid).max() < 1e-10 * np.abs(s.damping).max()
    assert np.array_equal(damping_of(s)[:3, :3], s.damping)


@pytest.mark.parametrize("ending", ["csv", "bdf", "unv"])
def test_a_file_says_what_the_data_leave_open(result, tmp_path, ending):
    doubtful = replace(result, determined=False, undetermined=("the modal mass of mode 2",), closed_by=())
    text = sysid.export(doubtful, tmp_path / f"m.{ending}").read_text(encoding="utf-8")
    assert "judgement: ONE OF MANY" in text and "open: the modal mass of mode 2" in text
    assert "judgement: NO FIT" in sysid.export(replace(result, success=False), tmp_path / f"m.{ending}").read_text()


def test_an_unknown_ending_is_told_with_those_that_exist(result, tmp_path):
    with pytest.raises(sysid.InputError, match=r"no format has the ending '\.doc'; there are \.csv"):
        sysid.export(result, tmp_path / "m.doc")
    assert not list(tmp_path.iterdir())


def test_the_command_writes_a_file_and_tells_its_precision(result, tmp_path, capsys):
    result.save(tmp_path / "result.h5")
    assert main(["export", str(tmp_path), str(tmp_path / "m.csv")]) == 0
    assert "precision: exact" in capsys.readouterr().out
    assert main(["export", str(tmp_path), str(tmp_path / "m.xls")]) == 2
