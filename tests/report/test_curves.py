"""The curves of the report: every channel of every test, with its noise and interval, with a script and without."""

import base64
import html
import json
import re
from types import SimpleNamespace

import numpy as np
from scipy.stats import norm

import sysid
from sysid.report.curves import curves
from sysid.report.opening import NoiseLevel, share_of_noise


def test_every_channel_of_every_test_is_in_its_curves(complete, page):
    data = [json.loads(one) for one in re.findall(r'<script type="application/json">(.*?)</script>', page, re.DOTALL)]
    shapes, fitted, unseen = data
    force = ["base force x", "base force y"]
    names = list(complete.measurement.sensor_names)
    assert [one["name"] for one in fitted["channels"]] == [*names, *force]
    assert [one["name"] for one in unseen["channels"]] == names
    assert (fitted["runs"], unseen["runs"]) == (["base x", "base y"], ["run 1", "run 2"])
    for shown, test in ((fitted, complete.measurement), (unseen, complete.problem.validation[0])):
        for lines in shown["freq"]:
            np.testing.assert_allclose(unpacked(lines), test.freq, rtol=1e-6)
        with_base = np.einsum("sd,rdf->rsf", test.rigid_body, test.base)
        # Phases against the base direction that moves a sensor most with it; in its own run a unit.
        most = np.argmax(np.linalg.norm(test.base, axis=-1)[:, None] * np.abs(test.rigid_body), axis=-1)
        base = np.take_along_axis(test.base, most[..., None], axis=1)
        turn = np.where(base != 0, base.conj(), 1) / np.where(base != 0, np.abs(base), 1)
        spectra = {
            "measured": turn * test.response,
            "identified": turn * (test.predict(complete.structure) + with_base),
        }
        for kind, expected in spectra.items():
            for s, run in np.ndindex(3, 2):
                size, turned = shown["channels"][s][kind][run]
                found = sizes(size) * np.exp(1j * np.deg2rad(0.5 * steps(turned)))
                np.testing.assert_allclose(found, expected[run, s], rtol=0.005)  # 0.05 % and 0.25 degrees
        for s, run in np.ndindex(3, 2):
            left = np.abs(spectra["measured"] - spectra["identified"])[run, s]
            np.testing.assert_allclose(sizes(shown["channels"][s]["left"][run]), left, rtol=0.0051)
    assert "noise" in fitted["channels"][0] and "noise" not in unseen["channels"][0]
    assert len(shapes["points"]) == 3 + 1 and len(shapes["shapes"]) == 3  # the sensors' places and the base
    assert shapes["shapes"][0][0] == [0, 0, 0]


def test_without_its_script_the_page_shows_all_curves_and_modes(complete, page):
    """Of each channel in each run; the script is what hides them."""
    sheets = re.findall(r'<div class="sheet"><p>(.*?)</p>(.*?)</div>', page, re.DOTALL)
    names = [*complete.measurement.sensor_names, "base force x", "base force y"]
    assert [html.unescape(name) for name, _ in sheets] == [
        *(f"{name}, base {axis}" for name in names for axis in "xy"),
        *(f"{name}, run {run}" for name in names[:3] for run in (1, 2)),
    ]
    for k, (_, drawing) in enumerate(sheets):
        kinds = re.findall(r'<path class="(measured|identified|left|noise|band)" d="M[^"]+"', drawing)
        fitted = ["noise"] * (k < 10)  # no noise is known of the test that was not fitted
        assert kinds == ["measured", "identified", "measured", "identified", "left", *fitted, "band"]
        assert "frequency [Hz]" in drawing and "phase [°]" in drawing
    (shapes,) = re.findall(r'<div class="shapes">(.*?)</div>', page)
    assert shapes.count("<svg") == shapes.count('class="base"') == complete.structure.n
    assert "noscript" not in page


def unpacked(text):
    return np.frombuffer(base64.b64decode(text), "<f4")


def test_curves_have_the_interval_of_their_own_lines(complete, page):
    _, fitted, unseen = [json.loads(one) for one in re.findall(r'json">(.*?)</script>', page, re.DOTALL)]
    u, test, (other,) = complete.uncertainty, complete.measurement, complete.problem.validation
    for s in range(3):
        std = u.transmissibility(test.freq)[s]
        for d in range(2):  # the base moves in one direction a run
            np.testing.assert_allclose(sizes(fitted["channels"][s]["band"][d]), norm.ppf(0.975) * std[d], rtol=1e-3)
        both = np.sum(u.transmissibility(other.freq)[s] * np.abs(other.base[1]), axis=0)
        np.testing.assert_allclose(sizes(unseen["channels"][s]["band"][1]), norm.ppf(0.975) * both, rtol=1e-3)
    std = u.base_force(test.freq)[1, 0]
    np.testing.assert_allclose(sizes(fitted["channels"][4]["band"][0]), norm.ppf(0.975) * std, rtol=1e-3)


def test_runs_of_other_lengths_are_drawn_at_their_own_lines():
    """Beside them the lines of the other run, at which it has zeros."""
    rng, lengths = np.random.default_rng(0), (400, 300)
    runs = [(u := rng.standard_normal((1, n)), 2 * u + 0.1 * rng.standard_normal((1, n)), None) for n in lengths]
    test = sysid.Measurement.from_time(runs, 10.0, rigid_body=[[1.0]], estimator="spectra")
    structure = sysid.Structure(np.diag([1.0, 0.0]), 400 * np.array([[1, -1], [-1, 1]]), [0.02], n_base=1)
    problem = SimpleNamespace(measurement=test)
    it = SimpleNamespace(structure=structure, quick_uncertainty=None, measurement=test, records=problem)
    element = curves(it, test, NoiseLevel(None, None, False))
    (data,) = map(json.loads, re.findall(r'<script type="application/json">(.*?)</script>', element, re.DOTALL))
    for run, n in enumerate(lengths):
        own = np.arange(1, n // 2 + 1) * 10.0 / n
        np.testing.assert_allclose(unpacked(data["freq"][run]), own, rtol=1e-6)
        measured = sizes(data["channels"][0]["measured"][run][0])
        size = np.abs(np.fft.rfft(runs[run][1][0])[1:] / 10.0)
        np.testing.assert_allclose(measured, size, rtol=1e-3)


def test_a_run_has_no_noise_at_the_lines_of_others():
    records = np.ones((2, 3, 8), complex)
    records[0, :, ::2], records[1, :, 1::2] = 0.0, 0.0
    np.testing.assert_allclose(share_of_noise(np.full((2, 3, 8), 0.1), records), 0.1)
    np.testing.assert_allclose(share_of_noise(np.full((2, 3, 1), 0.1), records), 0.1)


def steps(text):
    """Whole numbers by their differences, as LEB128 writes them, byte by byte."""
    found, value, whole, place = [], 0, 0, 0
    for byte in base64.b64decode(text):
        whole |= (byte & 127) << place
        place += 7
        if byte < 128:
            value += whole >> 1 if whole % 2 == 0 else -(whole + 1) // 2
            found.append(value)
            whole = place = 0
    return np.array(found)


def sizes(told):
    least, step, text = told
    above = steps(text)
    return np.where(above > 0, least * np.exp((above - 1) * step), 0.0)
