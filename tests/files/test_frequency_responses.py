"""Frequency responses of every form and file give the same transmissibility and apparent mass, or are asked for."""

import re

import h5py
import laboratory
import numpy as np
import pytest
import scipy.io
from laboratory import FREQ, F, H

import sysid
from sysid.files import reading, units

BASE = 1 / (10 + F)  # acceleration of a table of 10 kg for a unit force of its shaker
IW = 2j * np.pi * FREQ
ORDER = {"m/s²": 0, "m/s": 1, "m": 2}  # of differentiation that leads to acceleration
NAMES = ("h1", "h2", "h3")


def functions(upper, base, lower):
    """Columns and units of what sensors record in `upper` and the table in `base`, per unit of `lower`."""
    per = BASE if lower == "N" else IW ** ORDER[lower]
    found = {name: (row * per / IW ** ORDER[upper], f"{upper} / {lower}") for name, row in zip(NAMES, H, strict=True)}
    if lower == "N":
        found["table"] = (per / IW ** ORDER[base], f"{base}/N")
    return found | {"F": (F * per, f"N / {lower}")}


def write(path, ending, columns):
    named = {"freq": FREQ} | {name: values for name, (values, _) in columns.items()}
    if ending == "npz":
        np.savez(path, **named)
    elif ending == "mat":
        scipy.io.savemat(path, named)
    elif ending == "7.3":
        matlab_7_3(path, named)
    else:
        rows = [FREQ]
        heads = ["Frequency [Hz]"]
        for name, (values, unit) in columns.items():
            pair = (np.abs(values), np.angle(values, deg=True)) if ending == "phase" else (values.real, values.imag)
            rows += [values] if ending == "complex" else pair
            parts = [f"Mag({name}) [{unit}]", f"Phase({name}) [deg]"]
            parts = [f"{name} [{unit}]"] if ending == "complex" else parts
            heads += [f"{name}_{part} [{unit}]" for part in ("Re", "Im")] if ending == "parts" else parts
        lines = [
            ";".join(str(complex(x)) if np.iscomplexobj(x) else repr(float(x)) for x in line)
            for line in zip(*rows, strict=True)
        ]
        path.write_text("\n".join([";".join(heads), *lines]), encoding="utf-8")


def matlab_7_3(path, named):
    """As MATLAB writes version 7.3: text before the HDF5, columns, parts of complex numbers, texts as numbers."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in named.items():
            data = values[None, :]
            if np.iscomplexobj(values):
                data = np.zeros((1, values.size), [("real", "f8"), ("imag", "f8")])
                data["real"], data["imag"] = values.real, values.imag
            file[name] = data
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["note"] = np.arange(1000, dtype="u2")
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512))


def described(columns, stated):
    roles = {"table": "base", "F": "force"}
    sensors = [{"column": name, "role": roles.get(name, "response"), "axis": "x"} for name in columns]
    for sensor in sensors:
        if stated:
            sensor["unit"] = columns[sensor["column"]][1]
        if sensor["role"] == "response":
            sensor["position"] = [0, 0, int(sensor["column"][1])]
    return {"base_axes": "x", "sensor": sensors}


@pytest.mark.parametrize("ending", ["npz", "mat", "7.3", "parts", "phase", "complex"])
@pytest.mark.parametrize("conjugated", [False, True])
@pytest.mark.parametrize(
    "form",
    [
        ("m", "m", "N"),
        ("m/s", "m/s²", "N"),
        ("m/s²", "m/s", "N"),
        ("m/s", None, "m/s"),
        ("m", None, "m"),
        ("m/s²", None, "m"),
    ],
)
def test_forms_in_every_file_are_the_same_test(tmp_path, ending, conjugated, form):
    columns = functions(*form)
    if conjugated:
        columns = {name: (values.conj(), unit) for name, (values, unit) in columns.items()}
    path = tmp_path / {"npz": "a.npz", "mat": "a.mat", "7.3": "a.mat"}.get(ending, "a.csv")
    write(path, ending, columns)
    test = reading.gather(path, described(columns, path.suffix != ".csv"))
    base, response, force = test.runs[0]
    np.testing.assert_allclose(response / base, H, rtol=1e-10)
    np.testing.assert_allclose(force / base, F[None], rtol=1e-10)
    assert ("exp(-iwt)" if conjugated else "exp(+iwt)") in test.remarks[-1]


def test_each_reference_is_a_run_with_its_own_base_motion(tmp_path):
    pushes = {"s1": BASE, "s2": BASE * (1 + 0.3j * FREQ)}
    arrays = {f"{name}_{push}": row * B for push, B in pushes.items() for name, row in zip(NAMES, H, strict=True)}
    np.savez(tmp_path / "a.npz", freq=FREQ, **arrays, **{f"table_{push}": B for push, B in pushes.items()})
    sensors = [
        {"column": f"{name}_{push}", "name": name, "role": role, "axis": "x", "unit": "m/s²/N", "reference": push}
        for push in pushes
        for name, role in [(name, "response") for name in NAMES[::-1]] + [("table", "base")]
    ]
    test = reading.gather(tmp_path / "a.npz", {"convention": "exp(+iwt)", "sensor": sensors})
    assert [sensor.name for sensor in test.sensors] == list(NAMES[::-1])
    for (base, response, _), B in zip(test.runs, pushes.values(), strict=True):
        np.testing.assert_allclose(base[0], B, rtol=1e-12)
        np.testing.assert_allclose(response, (H * B)[::-1], rtol=1e-12)
    for sensor in sensors[:3]:
        sensor["name"] += " of s1"
    with pytest.raises(sysid.InputError, match=r"a\.npz: per unit of s1 that of 'h3' is missing.*same name"):
        reading.gather(tmp_path / "a.npz", {"convention": "exp(+iwt)", "sensor": sensors})


def universal(path, **given):
    """Sets 58 of accelerations per acceleration at nodes 1 to 3, in a file in mm and mN with their positions."""
    rows = given.pop("data", H)
    sets = [laboratory.function(node, row, **given) for node, row in enumerate(rows, 1)]
    laboratory.write_universal(path, [laboratory.IN_MM, laboratory.nodes([1e3, 2e3, 3e3]), *sets])


def test_a_universal_file_tells_axes_positions_units_and_the_sign_of_its_reference(tmp_path):
    said = {"base_axes": "x", "sensor": [{"column": f"{node}{{}}X", "role": "response"} for node in (1, 2, 3)]}
    for sign, direction in (("+", 1), ("-", -1)):
        universal(tmp_path / "a.uff", rsp_dir=direction, ref_dir=direction)
        signed = [{**one, "column": one["column"].format(sign)} for one in said["sensor"]]
        test = reading.gather(tmp_path / "a.uff", {**said, "sensor": signed})
        assert [sensor.axis for sensor in test.sensors] == [f"{sign}x".lstrip("+")] * 3
        assert [sensor.position[2] for sensor in test.sensors] == pytest.approx([1, 2, 3])
        np.testing.assert_allclose(test.runs[0][1] / test.runs[0][0], direction * H, rtol=1e-10)
        assert {row.unit for row in test.table} == {"mm/s² / mm/s²"}
    signed[0]["axis"] = "x"
    test = reading.gather(tmp_path / "a.uff", {**said, "sensor": signed})
    assert re.findall(r" (-?x),", test.remarks[0]) == ["-x", "x"]  # of the file, and of the description


@pytest.mark.parametrize(
    "given, base_axes, words",
    [
        ({"orddenom_spec_data_type": 13}, "x", r"per unit of force \(100\+X\).*role = \"base\""),
        ({"ref_dir": 2}, "x", r"reference '100\+Y' is no axis of the base \(x\)"),
        ({"ordinate_spec_data_type": 13}, "x", "'mN / mm/s²' does not fit.*a response sensor gives a motion"),
        (
            {"ordinate_spec_data_type": 0, "orddenom_spec_data_type": 0},
            "x",
            "no unit and no form is stated",
        ),
        ({"data": np.abs(H) + 0j}, "x", "are real numbers, magnitudes it seems: export complex ones"),
        ({"rsp_dir": 2}, "x", r"no column '1\+X'"),
    ],
)
def test_what_a_universal_file_does_not_tell_is_asked_for(tmp_path, given, base_axes, words):
    universal(tmp_path / "a.uff", **given)
    sensors = [{"column": f"{node}+X", "role": "response"} for node in (1, 2, 3)]
    with pytest.raises(sysid.InputError, match=words) as told:
        reading.gather(tmp_path / "a.uff", {"base_axes": base_axes, "convention": "exp(+iwt)", "sensor": sensors})
    assert "a.uff" in str(told.value)


@pytest.mark.parametrize(
    "heads, numbers, words",
    [
        ("freq;h1 imag", [FREQ, H[0].imag], "the imaginary part stands there, and no real"),
        ("freq;Mag(h1);Phase(h1)", [FREQ, np.abs(H[0]), np.angle(H[0])], "degrees or in radians"),
        ("freq;Mag(h1) [dB];Phase(h1) [rad]", [FREQ, np.abs(H[0]), np.angle(H[0])], "dB.*export them linear"),
        ("w;h1 re;h1 im", [FREQ, H[0].real, H[0].imag], "no frequencies that are named so.*--frequency"),
        ("freq [s];h1 re;h1 im", [FREQ, H[0].real, H[0].imag], "frequencies in 's'"),
        ("freq;h1 re;h1 im", [FREQ % 10, H[0].real, H[0].imag], "do not rise at line 200.*two tests"),
        ("freq;h1", [FREQ, np.abs(H[0])], "magnitudes it seems"),
    ],
)
def test_what_a_table_of_spectra_does_not_tell_is_asked_for(tmp_path, heads, numbers, words):
    np.savetxt(tmp_path / "a.csv", np.array(numbers).T, delimiter=";", header=heads, comments="")
    said = {"base_axes": "x", "frf": "transmissibility", "convention": "exp(+iwt)"}
    with pytest.raises(sysid.InputError, match=rf"a\.csv.*{words}"):
        reading.gather(tmp_path / "a.csv", {**said, "sensor": [{"column": "h1", "role": "response", "axis": "x"}]})


def test_frequencies_are_in_the_unit_that_the_file_states_or_told_to_be_in_hz(tmp_path):
    numbers = np.array([2 * np.pi * FREQ, H[0].real, H[0].imag])
    np.savetxt(tmp_path / "a.csv", numbers.T, delimiter=";", header="w [rad/s];h1 re;h1 im", comments="")
    np.savez(tmp_path / "a.npz", w=FREQ, h1=H[0])
    said = {"base_axes": "x", "frf": "transmissibility", "frequency": "w"}
    sensors = {"sensor": [{"column": "h1", "role": "response", "axis": "x"}]}
    for file, remarks in (("a.csv", 1), ("a.npz", 2)):
        test = reading.gather(tmp_path / file, said | sensors)
        np.testing.assert_allclose(test.freq, FREQ, rtol=1e-14)
        assert len(test.remarks) == remarks
    assert "no unit" in test.remarks[0] and "Hz" in test.remarks[0]


@pytest.mark.parametrize("said", [{"frf": "FRF"}, {"convention": "+"}])
def test_a_wrong_word_is_told_with_the_words_that_there_are(tmp_path, said):
    np.savez(tmp_path / "a.npz", freq=FREQ, h1=H[0])
    sensors = [{"column": "h1", "role": "response", "axis": "x"}]
    with pytest.raises(sysid.InputError, match=f"{next(iter(said.values()))!r} is unknown".replace("+", r"\+")) as told:
        reading.gather(tmp_path / "a.npz", {"base_axes": "x", "sensor": sensors} | said)
    assert "''" not in str(told.value)


@pytest.mark.parametrize("sign, axis, words", [(1, "x", "gives"), (-1, "x", "takes"), (-1, "-x", "gives")])
def test_the_sign_of_the_base_force_is_told_by_its_power(tmp_path, sign, axis, words):
    np.savez(tmp_path / "a.npz", freq=FREQ, h1=H[0], F=sign * F)
    sensors = [
        {"column": "h1", "role": "response", "axis": "x", "unit": "g/g"},
        {"column": "F", "role": "force", "axis": axis, "unit": "kg"},
    ]
    test = reading.gather(tmp_path / "a.npz", {"base_axes": "x", "sensor": sensors})
    assert f" {words} power" in test.remarks[0]
    np.testing.assert_allclose(test.runs[0][2][0], F * (-1 if words == "takes" else 1))


@pytest.mark.parametrize(
    "text, quantities, factor",
    [
        ("m/s²/N", ("acceleration", "force"), 1),
        ("(mm/s^2)/kN", ("acceleration", "force"), 1e-6),
        ("g / lbf", ("acceleration", "force"), 9.80665 / 4.4482216152605),
        ("mm/s/N", ("velocity", "force"), 1e-3),
        ("N/m/s²", ("force", "acceleration"), 1),
        ("m/s²/(m/s²)", ("acceleration", "acceleration"), 1),
    ],
)
def test_units_of_functions_are_told_apart_at_the_right_stroke(text, quantities, factor):
    above, below = units.ratio(text, "a function")
    assert (above.quantity, below.quantity) == quantities and above.factor / below.factor == pytest.approx(factor)
