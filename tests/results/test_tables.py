"""The noise of each channel of whole records is told: in the summary, in figures and in the report."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal

import sysid
from sysid.report.report import render
from sysid.results.tables import noise_of_channels, noise_source


@pytest.fixture(scope="module")
def answer():
    """One oscillator of 2 Hz and 2 % under random motion, with noise of 2, 1 and 3 % on sensor, base and force."""
    rng = np.random.default_rng(3)
    rate, n = 50.0, 4000
    w, ratio = 2 * np.pi * 2.0, 0.02
    fine = signal.resample(signal.sosfilt(signal.butter(4, 0.3, output="sos"), rng.standard_normal(n)), 8 * n)
    relative = signal.lsim(([[0, 1], [-(w**2), -2 * ratio * w]], [[0], [-1]], [[-(w**2), -2 * ratio * w]], [[-1]]),
                           fine, np.arange(8 * n) / (8 * rate))[1]  # fmt: skip
    base, response = fine[::8], (fine + relative)[::8]
    records, levels = [], []
    for clean, share in ((base, 0.01), (response, 0.02), (10.0 * response, 0.03)):
        levels.append(share * np.std(clean))
        records.append((clean + levels[-1] * rng.standard_normal(n))[None])
    noise = sysid.NoiseLevels(levels[1:2], levels[:1], levels[2:])
    test = sysid.Measurement.from_time([tuple(records)], rate, rigid_body=[[1.0]], noise=noise, band=(0.0, rate / 2))
    return sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=1)


def test_the_table_gives_level_unit_and_share_of_each_channel(answer):
    rows = noise_of_channels(answer)
    assert [(row.channel, row.unit) for row in rows] == [("sensor 1", "m/s²"), ("base x", "m/s²"), ("force x", "N")]
    np.testing.assert_allclose([row.percent for row in rows], [2.0, 1.0, 3.0], rtol=0.01)
    assert rows[2].level == answer.noise.force[0]


def test_shares_are_those_at_the_lines_and_runs_that_differ_are_told():
    """Noise and record of half the band, passed by a filter in time, over one another; levels of both runs."""
    rng, rate, n = np.random.default_rng(4), 50.0, 4000
    shape = signal.butter(4, 0.3, output="sos")
    runs, levels = [], (0.01, 0.03)
    for level in levels:
        clean = signal.sosfilt(shape, rng.standard_normal((2, n)), axis=1)
        runs.append((clean[:1], clean[1:] + level * rng.standard_normal((1, n)), None))
    test = sysid.Measurement.from_time(runs, rate, rigid_body=[[1.0]], band=(1.0, rate / 4))
    stated = sysid.NoiseLevels(np.array(levels)[:, None], np.array([0.02]))
    modal = [SimpleNamespace(density=test.whole.density, shares=None)]
    it = SimpleNamespace(noise=stated, modal=modal, records=SimpleNamespace(measurement=test))
    sensor, base = noise_of_channels(it)
    half = lambda x: signal.sosfilt(signal.butter(8, [1.0, rate / 4], "bandpass", fs=rate, output="sos"), x)  # noqa: E731
    noise = np.std([half(level * rng.standard_normal(n)) for level in levels])
    assert sensor.percent == pytest.approx(100 * noise / np.std([half(run[1][0]) for run in runs]), rel=0.05)
    assert sensor.level_in_words == "0.01 to 0.03" and base.level_in_words == "0.02"


def test_summary_figures_and_report_tell_it(answer, no_pictures):
    summary, source = answer.summary(), noise_source(answer)
    assert source == "as stated"
    assert f"noise {source}" in summary and "force x" in summary
    figures = json.loads(json.dumps(answer.to_dict()))["noise"]
    assert [one["channel"] for one in figures] == ["sensor 1", "base x", "force x"]
    section = render(answer).partition(">Noise</h2>")[2].partition("<h2")[0]
    assert source in section and all(one["channel"] in section for one in figures)
