"""Stills of curves: read back from the drawing, they are the curves."""

import re

import numpy as np
import pytest

from sysid.report.curves import _ABOVE, ChannelSpectra, _Axis, curve_sheet, degrees

NUMBER = r"-?[\d.]+"


def oscillator(freq, *, natural=10.0, ratio=0.01):
    """Transmissibility of one mass on a spring, in closed form."""
    r = freq / natural
    return (1 + 2j * ratio * r) / (1 - r**2 + 2j * ratio * r)


def sheet(freq, measured, identified=None, **levels):
    told = {"noise": None, "band": None} | levels
    identified = measured if identified is None else identified
    channel = ChannelSpectra("tip", "transmissibility", "–", measured, identified, **told)
    return curve_sheet("tip, base x", freq, channel)


def curves(drawing, kind):
    """Points of each curve of this kind, (points, 2) in pixels; pieces one below the other, with NaN between them."""
    found = []
    for path in re.findall(rf'<path class="{kind}" d="([^"]+)"', drawing):
        pieces = []
        for start, steps in re.findall(rf"M({NUMBER} {NUMBER})(?:l([-\d ]+))?", path):
            moves = np.array(re.findall(NUMBER, steps), float).reshape(-1, 2)
            pieces += [np.cumsum(np.vstack([np.array(start.split(), float), moves]), axis=0), [[np.nan, np.nan]]]
        found.append(np.vstack(pieces[:-1]) / 2)
    return found


def scales(drawing):
    """Factors from pixels to frequencies, and upwards to magnitudes, by the ticks that stand beside the axes."""
    below = re.findall(rf'<text x="({NUMBER})" y="268">({NUMBER})</text>', drawing)
    beside = re.findall(rf'<text x="43" y="({NUMBER})">({NUMBER})</text>', drawing)
    first = next((k for k, (_, value) in enumerate(beside) if value == "-180"), len(beside))
    lines = []
    for ticks, shift in ((below, 0.0), (beside[:first], -4.0)):
        at, value = np.array(ticks, float).T
        lines.append(np.polyfit(at + shift, np.log(value), 1))
    return [lambda pixels, line=line: np.exp(np.polyval(line, pixels)) for line in lines]


def test_a_curve_read_back_from_its_drawing_is_the_curve():
    freq = np.geomspace(1.0, 100.0, 120)
    (across, up), (found, *_) = scales(drawing := sheet(freq, oscillator(freq))), curves(drawing, "identified")
    seen = np.interp(np.log(across(found[:, 0])), np.log(freq), np.log(np.abs(oscillator(freq))))
    slope = np.max(np.abs(np.diff(np.log(np.abs(oscillator(freq)))) / np.diff(np.log(freq))))
    pixel = np.abs(np.log(up(1.0) / up(0.0))) + slope * np.abs(np.log(across(1.0) / across(0.0)))
    assert np.max(np.abs(np.log(up(found[:, 1])) - seen)) < pixel
    np.testing.assert_allclose(across(found[[0, -1], 0]), [1.0, 100.0], rtol=0.01)
    np.testing.assert_allclose(up(found[:, 1].min()), np.abs(oscillator(freq)).max(), rtol=up(0.0) / up(0.5) - 1)


def test_a_long_curve_keeps_its_peaks_and_is_small():
    freq = np.linspace(1.0, 40.0, 20_000)
    flat = np.ones(freq.size, complex)
    flat[7_000] = 50.0  # one line
    drawing = sheet(freq, oscillator(freq), flat, noise=np.full(freq.size, 0.01))
    _, up = scales(drawing)
    highest = curves(drawing, "identified")[0][:, 1].min()
    np.testing.assert_allclose(up(highest), 50.0, rtol=up(0.0) / up(0.5) - 1)  # half a pixel
    (noise,) = curves(drawing, "noise")
    assert len(noise) == 2 and noise[0, 1] == noise[1, 1]  # level from the first line to the last
    assert len(drawing) < 30_000


def test_a_phase_is_not_joined_where_it_comes_round():
    freq = np.linspace(1.0, 2.0, 101)
    turning = np.exp(-2j * np.pi * 2.5 * (freq - 1.0))  # two and a half turns
    _, phase = curves(sheet(freq, turning), "identified")
    assert np.isnan(phase[:, 0]).sum() == 2  # at -270 and -630 degrees
    slope = 2.5 * 46 / 304  # pixels: a turn is as high as the panel
    right, down = np.abs(np.diff(phase, axis=0)).T
    assert np.nanmax(down - slope * right) < 2.0  # not the height of the panel


def test_a_phase_at_its_step_stays_together():
    noisy = np.exp(1j * np.deg2rad([179.0, -179.0, 178.0, 1.0, -1.0, -90.0]))
    np.testing.assert_allclose(degrees(noisy), [-181.0, -179.0, -182.0, 1.0, -1.0, -90.0])


def test_what_was_not_measured_is_a_gap():
    freq = np.linspace(1.0, 20.0, 60)
    measured = oscillator(freq)
    measured[20:30] = np.nan
    drawing = sheet(freq, measured, oscillator(freq))
    assert [np.isnan(one[:, 0]).sum() for one in curves(drawing, "measured")] == [1, 1]
    assert "nan" not in drawing


@pytest.mark.parametrize("values", [np.zeros(30, complex), np.full(30, 2.0 + 0j)])
def test_what_is_level_or_nothing_has_axes(values):
    drawing = sheet(np.linspace(1.0, 3.0, 30), values)
    assert "nan" not in drawing and "inf" not in drawing
    assert sum(path.count("M") for path in re.findall('class="grid" d="(.*?)"', drawing)) > 10
    assert "0 at all lines" in drawing  # of the difference


def test_no_curve_is_joined_where_lines_were_left_out():
    freq = np.linspace(1.0, 20.0, 60)
    drawing = sheet(freq, oscillator(freq))
    assert not any(np.isnan(one).any() for one in curves(drawing, "identified"))
    channel = ChannelSpectra("tip", "transmissibility", "–", oscillator(freq), oscillator(freq), None, None)
    size, _ = curves(curve_sheet("tip", freq, channel, [25]), "identified")
    (gap,) = np.flatnonzero(np.isnan(size[:, 0]))
    across = scales(drawing)[0]
    np.testing.assert_allclose(across(size[[gap - 1, gap + 1], 0]), freq[24:26], rtol=0.01)


@pytest.mark.parametrize("height", [68.0, 86.0])
@pytest.mark.parametrize("decades", [1.0, 1.3, 1.8, 2.2, 3.0, 5.0])
def test_an_axis_of_a_decade_has_two_numbers_wherever_it_begins(height, decades):
    for low in np.geomspace(1e-3, 1e-2, 37):
        axis = _Axis(low, low * 10**decades * 1.000001, height, 0.0, True)
        ticks = axis.ticks(_ABOVE)
        assert len(ticks) >= 2
        assert np.min(np.abs(np.diff(axis(ticks)))) > 11.0  # the height of a number
