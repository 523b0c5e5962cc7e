"""Coherences of an analyser's functions become their noise, where averages are stated; else what is missing is told."""

import numpy as np
import pytest
from laboratory import FREQ, F, H, function, write_universal

import sysid
from sysid.errors import InputError
from sysid.files import reading, recorded_test
from sysid.measurement.spectra import blurred, std_of_functions

NAMES = ("h1", "h2", "h3", "F")
AVERAGES = 40
ROWS = np.vstack([H, F])
COHERENCE = np.linspace(0.9, 0.999, FREQ.size) ** np.arange(1, 5)[:, None]
EXPECTED = np.abs(ROWS) * np.sqrt((1 - COHERENCE) / (COHERENCE * AVERAGES))  # Bendat and Piersol, Random Data, ch. 9


def said(**given):
    sensors = [
        {"column": name, "role": "force" if name == "F" else "response", "axis": "x", "position": [0, 0, at]}
        | {"unit": "kg" if name == "F" else "g/g"}
        for at, name in enumerate(NAMES)
    ]
    return {"frf": "transmissibility", "base_axes": "x", "sensor": sensors} | given


def table(path, coherent=NAMES, coherence=COHERENCE):
    heads, rows = ["Frequency [Hz]"], [FREQ]
    for name, row, values in zip(NAMES, ROWS, coherence, strict=True):
        heads += [f"Re({name})", f"Im({name})", *[f"Coherence({name})"] * (name in coherent)]
        rows += [row.real, row.imag, *[values] * (name in coherent)]
    np.savetxt(path, np.array(rows).T, fmt="%.12g", delimiter=",", header=",".join(heads), comments="")
    return path


def test_deviations_are_those_of_estimates():
    # 300 estimates of a gain of 2 from 40 blocks of white noise with noise of .7 on the output.
    rng = np.random.default_rng(3)
    x, noise = (rng.standard_normal((2, 300, AVERAGES, 8, 2)) @ [1, 1j]) / np.sqrt(2)
    y = 2 * x + 0.7 * noise
    own, across, other = (np.mean(a * b.conj(), axis=1) for a, b in ((x, x), (y, x), (y, y)))
    estimate, coherence = across / own, np.abs(across) ** 2 / (own * other).real
    stated = std_of_functions(estimate, coherence, AVERAGES)
    assert np.sqrt(np.mean(np.abs(estimate - 2) ** 2)) == pytest.approx(np.sqrt(np.mean(stated**2)), rel=0.06)


def test_hanns_window_blurs_a_parabola_by_a_third_of_the_squared_distance_of_lines():
    freq = np.linspace(-1, 1, 41)  # its average over Hann's squared spectrum is off by h²/6 times 2
    np.testing.assert_allclose(blurred((freq**2).astype(complex))[1:-1], 0.05**2 / 3, rtol=1e-6)


@pytest.mark.parametrize("ending", ["csv", "unv"])
def test_coherences_beside_functions_are_their_noise(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    description = said(averages=AVERAGES)
    if ending == "csv":
        table(path)
    else:
        data = [13 if name == "F" else 12 for name in NAMES]
        sets = [
            function(at, row, func_type=kind, ord_data_type=6 if kind == 4 else 4, ordinate_spec_data_type=unit)
            for kind, rows in ((4, ROWS), (6, COHERENCE))
            for at, (row, unit) in enumerate(zip(rows, data, strict=True), 1)
        ]
        write_universal(path, sets)
        for at, sensor in enumerate(description["sensor"], 1):
            sensor["column"] = f"{at}+X"
            del sensor["unit"]
    test = reading.gather(path, description)
    np.testing.assert_allclose(test.response_std[0], EXPECTED[:3], rtol=1e-6)
    np.testing.assert_allclose(test.force_std[0], EXPECTED[3:], rtol=1e-6)
    (tmp_path / "test.h5").write_bytes(test.to_bytes())
    measurement = recorded_test.load(tmp_path / "test.h5").measurement()
    np.testing.assert_allclose(measurement.response_std[0], EXPECTED[:3], rtol=1e-6)
    assert measurement.averaged


def test_what_is_missing_beside_coherences_is_told(tmp_path):
    test = reading.gather(table(tmp_path / "a.csv"), said())
    assert test.response_std is None
    assert any("averages = 40" in remark for remark in test.remarks)
    test = reading.gather(table(tmp_path / "b.csv", NAMES[1:]), said(averages=AVERAGES))
    assert test.response_std is None
    assert any("'h1' is missing" in remark for remark in test.remarks)
    bare = reading.gather(table(tmp_path / "c.csv", ()), said(window="hann", averages=AVERAGES))
    assert bare.measurement().averaged
    assert not any("coherence" in remark for remark in bare.remarks)


@pytest.mark.parametrize(
    ("given", "words"),
    [({"window": "flat top"}, "hann"), ({"averages": 1}, "2 or above"), ({"averages": "x"}, "whole")],
)
def test_a_window_or_number_that_is_none_is_refused(tmp_path, given, words):
    with pytest.raises(InputError, match=words):
        reading.gather(table(tmp_path / "a.csv"), said(**given))


def test_a_coherence_above_one_is_refused_with_its_place(tmp_path):
    with pytest.raises(InputError, match=r"Coherence\(h1\).*between 0 and 1"):
        reading.gather(table(tmp_path / "a.csv", coherence=COHERENCE + 0.2), said(averages=AVERAGES))


def test_functions_in_python_take_coherences_too():
    given = {"rigid_body": np.ones((3, 1)), "force": F[None, None], "averages": AVERAGES}
    test = sysid.Measurement.from_frf(FREQ, H, coherence=COHERENCE[:3, None], force_coherence=COHERENCE[3], **given)
    np.testing.assert_allclose(test.response_std[0], EXPECTED[:3], rtol=1e-9)
    np.testing.assert_allclose(test.force_std[0], EXPECTED[3:], rtol=1e-9)
    assert test.averaged
    with pytest.raises(InputError, match="averages"):
        sysid.Measurement.from_frf(FREQ, H, rigid_body=np.ones((3, 1)), coherence=0.9)
    with pytest.raises(InputError, match="between 0 and 1"):
        sysid.Measurement.from_frf(FREQ, H, coherence=1.2, **given)


def test_coherences_of_functions_of_one_direction_have_a_row_a_sensor():
    freq, functions = np.linspace(1.0, 20.0, 8), np.ones((3, 8)) + 0.5j
    given = {"averages": 40, "rigid_body": np.ones((3, 1))}
    test = sysid.Measurement.from_frf(freq, functions, coherence=np.full((3, 8), 0.9), **given)
    alike = sysid.Measurement.from_frf(freq, functions, coherence=np.full(8, 0.9), **given)
    np.testing.assert_array_equal(test.response_std, alike.response_std)
    with pytest.raises(InputError, match=r"coherence is \(3, 7\)"):
        sysid.Measurement.from_frf(freq, functions, coherence=np.full((3, 7), 0.9), **given)
