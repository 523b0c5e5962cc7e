"""The page in a browser: its controls, its first screen, its contrast and width, and its print."""

import dataclasses
import re

import numpy as np
import pytest

import sysid
from benchmarks.page import browser
from sysid.report import report

pytestmark = pytest.mark.skipif(browser.CHROMIUM is None, reason="no Chromium is installed")


@pytest.fixture(scope="module")
def result(truth):
    sensors = [sysid.Sensor(f"s{i}", (0, 0, i), axis) for i, axis in enumerate(("x", (0.6, 0.8, 0.0), "y"), 1)]
    test = sysid.simulate(truth, np.linspace(1.0, 120.0, 200), noise=0.01, force=True, rng=3)
    return sysid.identify(sysid.Problem(dataclasses.replace(test, sensors=sensors), mass=sysid.FullMass()), rng=0)


@pytest.fixture(scope="module")
def page_of_result(result):
    assert result.determined
    return report.render(result)


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (768, True), (380, False)])
def test_every_control_works_and_the_page_is_readable(page_of_result, tmp_path, width, dark):
    told = browser.measured(page_of_result, tmp_path, width, dark=dark)
    assert told["errors"] == []
    assert told["used"]["select"] >= 4 and set(told["used"]) >= {"Zoom in", "Zoom out", "All lines", "Stop"}
    assert "Hz: measured" in told["hover"] and "noise" in told["hover"] and "95 % interval" in told["hover"]
    assert told["zoomed"] and told["whole"] and told["all_lines"] and told["keys"] and told["moved"]
    assert told["sheets"] == (3 + 2) * 2 and told["stills"] == 0  # every channel of both runs, on paper alone
    assert told["over"] == [] and told["sideways"] <= 0
    assert told["cut"] == []  # no picture at any width, no table on a wide screen
    assert max(told["first"]) < 800  # judgement, next step, masses and frequencies on the first screen
    assert told["contrast"] >= 4.5
    assert (sum(map(int, re.findall(r"\d+", told["paper"])[:3])) < 150) == dark


def test_without_scripts_all_curves_and_mode_shapes_are_seen(page_of_result, tmp_path):
    told = browser.seen_without_scripts(page_of_result, tmp_path, 380)
    assert told == {"sheets": (3 + 2) * 2, "modes": 3, "controls": 0, "sideways": 0}


def test_the_page_prints(result, tmp_path):
    assert browser.pages_printed(report.write_report(result, tmp_path), tmp_path) > 2


def test_whole_records_are_shown_with_their_transients_where_asked(random_structure, tmp_path):
    truth = random_structure(np.random.default_rng(3), 1, 1, G=np.ones((1, 1)))
    base = np.random.default_rng(4).standard_normal((1, 900))
    rate = 8 * truth.natural_frequencies[0]
    response = truth.simulate(base, rate)
    noisy = response + 0.01 * np.random.default_rng(5).standard_normal(response.shape)
    band = (0.05 * rate, 0.3 * rate)
    test = sysid.Measurement.from_time([(base, noisy, None)], rate, rigid_body=np.ones((1, 1)), band=band)
    it = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    page = report.render(it)
    assert it.records.measurement.is_whole
    told = browser.measured(page, tmp_path, 768)
    assert told["errors"] == [] and told["used"]["checkbox"] == 1
