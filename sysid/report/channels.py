"""Tables of the page about channels: their noise, and gains and delays of sensors."""

from __future__ import annotations

from sysid.report.html import aligned, number, table
from sysid.report.opening import rounded
from sysid.results import tables
from sysid.results.identification import Identification


def noise(it: Identification) -> str:
    """The noise of each channel."""
    found = tables.noise_of_channels(it)
    rows = [(one.channel, one.level_in_words, one.unit, aligned(one.percent), *one.signal_in_words) for one in found]
    of = "a sample in time, of noise up to half the sample rate"
    if grows := it.modal[0].shares is not None:
        of = "a line, of all lines together"
    caption = (
        f"Noise of each channel, {tables.noise_source(it)}: standard deviation of {of} (from least to most, where runs "
        "differ), and its share of what was recorded at the lines."
        + " The last column: the part of the noise that grows with the signal, as a share of it at each line; at most "
        "5 % is looked for." * grows
    )
    return table(("channel", *tables.noise_columns(it)), rows, caption)


def sensors(it: Identification) -> str:
    """The gain of each sensor as the records show it, and its delay."""
    found = tables.gains_of_sensors(it)
    priced = it.determined and any(g.worth > 0 for g in found)  # else M_SS has no deviation, or was stated
    late, within = any(g.delay for g in found), it.modal[0].calibration is not None
    caption = (
        "Gain of each sensor against the base, as the constant term of the transmissibility shows it; masses assume 1. "
        "±: half of the 95 % interval."
        + " What is likely within stated tolerances was taken off, and the intervals of M, K and C hold the rest."
        * within
        + " Delay: by which the records were late; it was taken off." * late
        + " The last column: by how many of its stated deviations M_SS is off where a gain is 1 % off." * priced
    )
    head = ("sensor", "gain", "±", *["delay, ms", "±"] * late, *["1 % moves M_SS by, deviations"] * priced)
    delays = [rounded(1e3 * g.delay, 1e3 * g.delay_std) * late for g in found]
    rows = [
        (g.sensor, *rounded(g.gain, g.std), *delay, *[number(g.worth, 2)] * priced)
        for g, delay in zip(found, delays, strict=True)
    ]
    return table(head, rows, caption)
