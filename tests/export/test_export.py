"""Exported files keep the numbers, say what is open, and are written whole or not at all."""

import csv
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.io import loadmat

import sysid
from sysid.cli.main import main
from sysid.export.content import Content, _turned, entry_unit, matrices_of, reliability
from sysid.export.state_space import control_system
from sysid.finding import Finding, Severity

OPEN = Finding("open", Severity.CAUTION, "the modal mass of mode 2")
CHANGING = Finding("changing", Severity.CONTRADICTS, "f1 falls with level")
NO_END = Finding("no solution", Severity.CONTRADICTS, "no end")


def read_table(path):
    """Rows of a table, and values and deviations by matrix; NaN where there is none."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    size = max(int(row["row"]) for row in rows)
    both = {"value": {}, "deviation": {}}
    for name, found in both.items():
        for row in rows:
            matrix = found.setdefault(row["matrix"], np.full((size, size), np.nan))
            matrix[int(row["row"]) - 1, int(row["column"]) - 1] = float(row[name] or "nan")
    return rows, both["value"], both["deviation"]


def test_a_table_keeps_every_number_and_tells_units_and_judgement(result, tmp_path):
    path = sysid.export(result, tmp_path / "new" / "m.csv")
    lines, (rows, values, _) = path.read_text(encoding="utf-8").splitlines(), read_table(path)
    s = result.structure
    for letter, matrix in (("M", s.mass), ("K", s.stiffness), ("C", matrices_of(s)["C"])):
        assert np.array_equal(values[letter], matrix)
    assert {r["unit"] for r in rows} == {f"{u}{m}" for u in ("kg",) for m in ("", " m", " m2")} | {
        "N/m",
        "N",
        "N m",
        "N s/m",
        "N s",
        "N s m",
    }
    assert rows[3]["column_name"] == "base x" and rows[3]["row_name"] == "floor 1 (x)"
    head = "\n".join(line for line in lines if line.startswith("#"))
    assert "judgement: " in head and "units: " in head and sysid.__version__ in head


def test_a_matlab_file_keeps_every_number(result, tmp_path):
    read = loadmat(sysid.export(result, tmp_path / "m.mat"))
    s, system = result.structure, result.structure.to_state_space()
    for name, value in {"M": s.mass, "K": s.stiffness, "Phi": s.mode_shapes, "G": s.rigid_body, "A": system.A}.items():
        assert np.array_equal(read[name], value), name
    floors = [f"floor {k} (x)" for k in (1, 2, 3)]
    assert [str(cell[0]) for cell in read["dof_names"][:, 0]] == [*floors, "base x", "base ry"]
    assert any(str(cell[0]).startswith("judgement: ") for cell in read["about"][:, 0])


def test_deviations_stand_beside_the_entries_and_hold_the_true_ones(noisy, tmp_path):
    truth, result, _ = noisy
    _, values, deviations = read_table(sysid.export(result, tmp_path / "m.csv"))
    mat = loadmat(sysid.export(result, tmp_path / "m.mat"))
    blocks = {"M": truth.mass, "K": truth.stiffness, "C": truth.damping}
    for letter, name in (("M", "mass"), ("K", "stiffness"), ("C", "damping")):
        std = deviations[letter]
        assert np.array_equal(std[:3, :3], getattr(result.uncertainty, name))
        assert np.isnan(std[3:]).all() and np.isnan(std[:, 3:]).all()  # the base has none
        assert np.array_equal(std, mat[f"{letter}_std"], equal_nan=True)
        found, std = values[letter][:3, :3], std[:3, :3]
        assert np.all(np.abs(found - blocks[letter][:3, :3]) < 4 * std)
        assert np.all(np.diag(std) < 0.15 * np.diag(found))


def test_entries_that_the_data_leave_open_have_no_deviation(noisy, tmp_path):
    _, _, without_force = noisy
    deviations = read_table(sysid.export(without_force, tmp_path / "m.csv"))[2]
    mat = loadmat(sysid.export(without_force, tmp_path / "m.mat"))
    assert all(np.isnan(std).all() for std in (*deviations.values(), mat["M_std"], mat["K_std"], mat["C_std"]))
    about = [str(cell[0]) for cell in mat["about"][:, 0]]
    assert any(line.startswith("open: all modal masses are open") for line in about) and not mat["determined"][0, 0]


def test_a_coordinate_that_no_sensor_records_has_no_unit(result):
    s = result.structure
    between = [[1, 0, 0], [0, 1, 0], [0, 0.5, 0.5]]  # the third sensor sees two coordinates
    other = sysid.Structure(s.mass, s.stiffness, s.damping_ratios, n_base=2, recovery=between)
    kinds = Content.of(replace(result, structure=other)).rotations
    assert kinds == (False, False, None, False, True)
    assert [entry_unit("M", kinds[0], kinds[j]) for j in range(5)] == ["kg", "kg", "", "kg", "kg m"]
    assert entry_unit("K", True, True) == "N m" and entry_unit("C", True, None) == ""


NEEDS = {"m.op4": ("pyyeti", "nastran"), "system": ("control", "control")}


@pytest.mark.parametrize("file", NEEDS)
def test_a_missing_extra_is_one_line_with_the_remedy(result, tmp_path, monkeypatch, file):
    package, extra = NEEDS[file]
    monkeypatch.setitem(sys.modules, package, None)
    remedy = rf"needs the package {package}: python -m pip install 'structural-sysid\[{extra}\]'$"
    with pytest.raises(sysid.InputError, match=remedy):
        control_system(result) if file == "system" else sysid.export(result, tmp_path / file)
    assert not list(tmp_path.iterdir())


def test_a_rigid_motion_strains_nothing_and_carries_the_total_mass(result, tmp_path):
    values = read_table(sysid.export(result, tmp_path / "m.csv"))[1]
    rigid = np.vstack([result.structure.rigid_body_dofs, np.eye(2)])
    assert np.abs(values["K"] @ rigid).max() < 1e-10 * np.abs(values["K"]).max()
    assert np.abs(values["C"] @ rigid).max() < 1e-10 * np.abs(values["C"]).max()
    # 20, 15 and 10 kg at 1, 2 and 3 m, and 5 kg, 8 kg m² of the base.
    total = [[20 + 15 + 10 + 5, 20 + 2 * 15 + 3 * 10], [20 + 2 * 15 + 3 * 10, 20 + 4 * 15 + 9 * 10 + 8]]
    np.testing.assert_allclose(rigid.T @ values["M"] @ rigid, total, rtol=1e-6)


@pytest.mark.parametrize("ending", ["csv", "bdf", "unv"])
def test_a_file_says_what_the_data_leave_open(result, tmp_path, ending):
    open_ = result.with_findings([OPEN])
    text = sysid.export(open_, tmp_path / f"m.{ending}").read_text(encoding="utf-8")
    assert "judgement: ONE OF MANY" in text and f"open: {OPEN}" in text
    assert "judgement: NO FIT" in sysid.export(result.with_findings([NO_END]), tmp_path / f"m.{ending}").read_text()


@pytest.mark.parametrize("ending", ["csv", "bdf", "unv"])
def test_what_speaks_against_an_answer_and_what_is_open_stand_under_their_own_words(result, tmp_path, ending):
    doubted = replace(result.with_findings([CHANGING, OPEN]), interrupted=True)
    text = sysid.export(doubted, tmp_path / f"m.{ending}").read_text(encoding="utf-8")
    assert text.count(f"against: {CHANGING}") == 1 and f"open: {CHANGING}" not in text
    assert text.count(f"open: {OPEN}") == 1
    judged = reliability(doubted)
    assert f"judgement: {judged}; " in re.sub(r"[\s$]+", " ", text) and "DOUBTFUL" in judged
    assert "interrupted" in judged and judged.endswith("see 'against' and 'open'")


def test_an_unknown_ending_is_told_with_those_that_exist(result, tmp_path):
    with pytest.raises(sysid.InputError, match=r"no format has the ending '\.doc'; there are \.csv"):
        sysid.export(result, tmp_path / "m.doc")
    assert not list(tmp_path.iterdir())


def test_the_command_writes_a_file_and_tells_its_precision(result, tmp_path, capsys):
    result.save(tmp_path / "result.h5")
    assert main(["export", str(tmp_path), str(tmp_path / "m.csv")]) == 0
    said = capsys.readouterr()
    assert "precision: exact" in said.out and "without deviations" not in said.out and not said.err
    assert main(["export", str(tmp_path), str(tmp_path / "m.unv")]) == 0
    assert "without deviations, which .csv and .mat have" in capsys.readouterr().out
    assert main(["export", str(tmp_path), str(tmp_path / "m.xls")]) == 2


@pytest.mark.parametrize(
    "finding, interrupted, told",
    [
        (OPEN, False, ("ONE OF MANY", "'open'")),
        (CHANGING, False, ("DOUBTFUL", "'against'")),
        (NO_END, False, ("NO FIT", "'against'")),
        (OPEN, True, ("interrupted", "'open'")),
    ],
)
def test_the_command_warns_in_one_line_of_matrices_that_are_not_determined(
    result, tmp_path, capsys, finding, interrupted, told
):
    replace(result.with_findings([finding]), interrupted=interrupted).save(tmp_path / "result.h5")
    assert main(["export", str(tmp_path), str(tmp_path / "m.csv")]) == 0
    said = capsys.readouterr()
    (line,) = said.err.splitlines()
    assert line.startswith("sysid: warning: m.csv: ") and all(word in line for word in told)
    assert "m.csv" in said.out


@pytest.fixture(scope="module")
def upside_down(result):
    """The result as its second sensor, at the other end of its axis, would have given it, and sensors of two axes."""
    signs = np.array([1.0, -1.0, 1.0])
    s, test = result.structure, result.measurement
    both = np.concatenate([signs, np.ones(2)])
    sensors = [replace(one, axis="-x" if sign < 0 else one.axis) for one, sign in zip(test.sensors, signs, strict=True)]
    records = sysid.Measurement(
        test.freq, test.base, test.response * signs[:, None], force=test.force, sensors=sensors, base_axes="x ry",
        rigid_body=test.rigid_body * signs[:, None],
    )  # fmt: skip
    problem = sysid.Problem(records, mass=sysid.FullMass(), stiffness=sysid.SpectralStiffness())
    return np.outer(both, both), s, sysid.identify(problem)


@pytest.mark.parametrize("positive", [False, True])
def test_rows_name_their_axis_and_sign_and_are_turned_on_request(upside_down, tmp_path, positive):
    signs, s, found = upside_down
    signs = np.ones_like(signs) if positive else signs
    rows, values, deviations = read_table(sysid.export(found, tmp_path / "m.csv", positive_axes=positive))
    mat = loadmat(sysid.export(found, tmp_path / "m.mat", positive_axes=positive))
    for letter, matrix in matrices_of(s).items():
        for read in (values[letter], mat[letter]):
            np.testing.assert_allclose(read, signs * matrix, atol=1e-6 * np.abs(matrix).max())
    second = "floor 2 (x)" if positive else "floor 2 (-x)"
    assert {row["row_name"] for row in rows if row["row"] == "2"} == {second}
    assert str(mat["dof_names"][1, 0][0]) == str(mat["sensor_names"][1, 0][0]) == second
    np.testing.assert_array_equal(deviations["K"], mat["K_std"])
    about = [str(cell[0]) for cell in mat["about"][:, 0]]
    assert any("turned" in line and "floor 2 (-x)" in line for line in about) == positive
    system, plain = control_system(found, positive_axes=positive), s.to_state_space()
    assert system.output_labels == ["floor 1 (x)", second, "floor 3 (x)"]
    gain = signs[1, 0] * plain.D
    np.testing.assert_allclose(system.D[1], gain[1], atol=1e-6 * np.abs(plain.D).max())


def test_turned_rows_answer_like_the_turned_sensors(upside_down):
    _, s, found = upside_down
    turned, f = Content.of(found, True).structure, np.linspace(3.0, 30.0, 20)
    for name in ("transmissibility", "base_force"):
        wanted = getattr(s, name)(f)
        np.testing.assert_allclose(getattr(turned, name)(f), wanted, atol=1e-6 * np.abs(wanted).max())


def test_residual_modes_and_coordinates_of_no_sensor_are_turned_with_the_sensors(in_band):
    signs = np.array([1.0, -1, 1, -1, -1, 1])
    axes = ["x" if sign > 0 else "-x" for sign in signs]
    described = [sysid.Sensor(f"s{k}", (0, 0, k), axis) for k, axis in enumerate(axes)]
    content = Content(in_band, in_band.structure, tuple(described))
    turned = _turned(in_band.structure, signs, tuple(described))
    f = np.linspace(5.0, 30.0, 30)
    wanted = in_band.structure.transmissibility(f) * signs[:, None, None]
    np.testing.assert_allclose(turned.transmissibility(f), wanted, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(turned.base_force(f), in_band.structure.base_force(f), rtol=1e-9, atol=1e-9)
    assert [name.endswith("(-x)") for name in content.sensor_names] == [sign < 0 for sign in signs]


def test_positive_axes_of_sensors_that_are_not_described_are_refused(noisy, tmp_path):
    with pytest.raises(sysid.InputError, match="describe"):
        sysid.export(noisy[1], tmp_path / "m.csv", positive_axes=True)
