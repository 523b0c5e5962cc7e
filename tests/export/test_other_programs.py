"""Reading of exported files by other programs, and how they answer to a moving base."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.io

import sysid
from sysid.export.state_space import control_system

FREQ = np.linspace(2.0, 40.0, 300)


def base_driven(mass, damping, stiffness, recovery, base):
    """pyYeti's answer to unit accelerations of the base: transmissibility and apparent mass."""
    cb = pytest.importorskip("pyyeti.cb")
    driven = [cb.cbtf(mass, damping, stiffness, unit, FREQ, np.arange(base)) for unit in np.eye(base)]
    sensors = np.stack([recovery @ answer.a for answer in driven], axis=1)
    return sensors, np.stack([answer.frc for answer in driven], axis=1)


def assert_answers_alike(structure, driven, tolerance):
    for found, right in zip(driven, (structure.transmissibility(FREQ), structure.base_force(FREQ)), strict=True):
        assert np.abs(found - right).max() < tolerance * np.abs(right).max()


def test_an_op4_file_keeps_every_number_and_its_superelement_answers_as_identified(result, tmp_path):
    op4 = pytest.importorskip("pyyeti.nastran.op4")
    read = op4.read(str(sysid.export(result, tmp_path / "m.op4")))
    s = result.structure
    assert np.array_equal(read["m"], s.mass) and np.array_equal(read["k"], s.stiffness)
    assert_answers_alike(s, base_driven(read["mcb"], read["ccb"], read["kcb"], read["rcb"], 2), 1e-10)
    assert read["determnd"][0, 0] == result.determined
    note = ["".join(map(chr, row.astype(int))).rstrip() for row in read["note"]]
    assert any(line.startswith("judgement: determined") for line in note)
    rigid = np.r_[s.rigid_body[:, 0], 1.0, 0.0]  # 1 m/s² in x: no elastic force, 20 + 15 + 10 + 5 kg
    assert np.abs(read["k"] @ rigid).max() < 1e-10 * np.abs(read["k"]).max()
    assert rigid @ read["m"] @ rigid == pytest.approx(50.0, rel=1e-6)
    assert np.array_equal(read["kcb"][:2], np.zeros((2, 5))) and read["mcb"][0, 0] == pytest.approx(50.0, rel=1e-6)


def test_an_op4_file_notes_what_the_data_leave_open(noisy, tmp_path):
    op4 = pytest.importorskip("pyyeti.nastran.op4")
    read = op4.read(str(sysid.export(noisy[2], tmp_path / "m.op4")))
    note = "\n".join("".join(map(chr, row.astype(int))).rstrip() for row in read["note"])
    assert read["determnd"][0, 0] == 0
    assert "judgement: ONE OF MANY" in note
    lines = " ".join(note.split())
    assert all(f"open: {one}" in lines for one in noisy[2].open_findings) and noisy[2].open_masses == (0, 1, 2)


def test_a_superelement_with_damping_that_is_not_classical_answers_as_its_structure(result, tmp_path):
    op4 = pytest.importorskip("pyyeti.nastran.op4")
    s = result.structure
    dampers = 30.0 * np.array([[5.0, -1, 0], [-1, 1.5, -0.5], [0, -0.5, 0.5]])
    damped = sysid.Structure(s.mass, s.stiffness, damping_matrix=dampers, n_base=2)
    read = op4.read(str(sysid.export(replace(result, structure=damped), tmp_path / "m.op4")))
    modal = read["ccb"][2:, 2:]
    assert np.abs(modal - np.diag(np.diag(modal))).max() > 0.1 * np.diag(modal).max()
    assert_answers_alike(damped, base_driven(read["mcb"], read["ccb"], read["kcb"], read["rcb"], 2), 1e-10)


def test_a_dmig_deck_keeps_ten_digits_and_answers_as_identified(result, tmp_path):
    bulk = pytest.importorskip("pyyeti.nastran.bulk")
    path = sysid.export(result, tmp_path / "m.bdf")
    read = bulk.rddmig(str(path))
    points = [(1, 1), (1, 5), (1001, 0), (1002, 0), (1003, 0)]
    form = result.structure.to_craig_bampton()
    order = np.ix_([3, 4, 0, 1, 2], [3, 4, 0, 1, 2])
    K, M, C = (read[name].reindex(index=points, columns=points).fillna(0).to_numpy() for name in ("kcb", "mcb", "bcb"))
    R = read["rcb"].reindex(columns=points).to_numpy()
    for found, right in ((M, form.mass), (K, form.stiffness), (C, form.damping)):
        np.testing.assert_allclose(found, right[order], rtol=5.1e-10, atol=1e-90)
    assert_answers_alike(result.structure, base_driven(M, C, K, R, 2), 1e-6)
    text = path.read_text()
    assert "$ judgement: determined" in text and max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize("file", ["m.op4", "m.bdf", "m.mat"])
def test_files_of_an_answer_in_the_band_hold_its_residual_modes(in_band, tmp_path, file):
    s, path = in_band.structure, tmp_path / file
    assert in_band.determined and (s.n, s.n_sensors) == (4, 6) and s.residual.count
    q = [1001 + k for k in range(4 + s.residual.count)]
    if file == "m.mat":
        read = scipy.io.loadmat(sysid.export(in_band, path))
        system = [read[name] for name in ("A", "B", "Cy", "D")]
        answer = [system[2] @ np.linalg.solve(2j * np.pi * f * np.eye(2 * len(q)) - system[0], system[1]) + system[3]
                  for f in FREQ]  # fmt: skip
        right = s.transmissibility(FREQ)
        assert np.abs(np.stack(answer, axis=-1) - right).max() < 1e-8 * np.abs(right).max()
        assert np.array_equal(read["f_hz_residual"][:, 0], s.residual.natural_frequencies)
    elif file == "m.op4":
        read = pytest.importorskip("pyyeti.nastran.op4").read(str(sysid.export(in_band, path)))
        assert_answers_alike(s, base_driven(read["mcb"], read["ccb"], read["kcb"], read["rcb"], 2), 1e-9)
    else:
        read = pytest.importorskip("pyyeti.nastran.bulk").rddmig(str(sysid.export(in_band, path)))
        points = [(1, 1), (1, 2), *((point, 0) for point in q)]
        K, M, C = (
            read[key].reindex(index=points, columns=points).fillna(0).to_numpy() for key in ("kcb", "mcb", "bcb")
        )
        R = read["rcb"].reindex(columns=points).fillna(0).to_numpy()
        assert_answers_alike(s, base_driven(M, C, K, R, 2), 1e-6)
        assert "residual modes" in " ".join(path.read_text().replace("$", "").split())


def test_a_stored_answer_in_the_band_keeps_its_residual_modes(in_band, tmp_path):
    again = sysid.load(in_band.save(tmp_path / "result.h5"))
    assert np.array_equal(again.structure.base_force(FREQ), in_band.structure.base_force(FREQ))
    assert again.judgement == in_band.judgement == "determined"
    u, v = again.uncertainty, in_band.uncertainty
    np.testing.assert_allclose(u.mass, v.mass, rtol=1e-6)


def test_a_universal_file_keeps_modes_to_1e_5(result, tmp_path):
    pyuff = pytest.importorskip("pyuff")
    file = pyuff.UFF(str(sysid.export(result, tmp_path / "m.unv")))
    modes = [file.read_sets(int(k)) for k in np.flatnonzero(file.get_set_types() == 55)]
    s = result.structure
    np.testing.assert_allclose([mode["freq"] for mode in modes], s.natural_frequencies, rtol=1e-5)
    np.testing.assert_allclose([mode["modal_damp_vis"] for mode in modes], s.damping_ratios, rtol=1e-5)
    np.testing.assert_allclose(np.transpose([mode["r1"] for mode in modes]), s.mode_shapes, rtol=1e-5)
    assert modes[0]["id1"].startswith("determined")


def test_python_control_answers_as_identified(result):
    control = pytest.importorskip("control")
    system = control_system(result)
    frequencies, ratios, _ = control.damp(system, doprint=False)
    order = np.argsort(frequencies)[::2]
    np.testing.assert_allclose(frequencies[order], 2 * np.pi * result.structure.natural_frequencies, rtol=1e-10)
    np.testing.assert_allclose(ratios[order], result.structure.damping_ratios, rtol=1e-8)
    answer = system(2j * np.pi * FREQ)
    right = result.structure.transmissibility(FREQ)
    assert np.abs(answer - right).max() < 1e-10 * np.abs(right).max()
    assert system.input_labels == ["base x", "base ry"]
    assert system.output_labels == ["floor 1 (x)", "floor 2 (x)", "floor 3 (x)"]
