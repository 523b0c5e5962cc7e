"""Kind of test that a recording seems to be, and what it does not tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.files.recording import Column, Recording, is_abscissa
from sysid.structure.structure import Array


def kind_of(recording: Recording, base: Sequence[str] = ()) -> str:
    """Kind of test in words: by the columns of the base where they are known, else by what most columns show."""
    columns = [one for one in channels_of(recording) if not base or one.name in base] or channels_of(recording)
    if recording.freq is not None and recording.freq.size < 2:
        return "too short to tell"
    if recording.freq is not None:
        what = "functions" if any(np.any(np.imag(one.values)) for one in columns) else "magnitudes alone"
        even = np.ptp(np.diff(recording.freq)) < 0.01 * np.mean(np.diff(recording.freq))
        return f"{what} of an analyser" if even else f"{what} at uneven lines, as of a stepped sine"
    rows = [np.real(one.values) - np.mean(np.real(one.values)) for one in columns if np.all(np.isfinite(one.values))]
    rows = [row for row in rows if row.size >= 64 and np.any(row)]
    if not rows:
        return "too short to tell"
    periods = [_periods(row) for row in rows]
    # Successive periods of a sine are alike, those of random motion are not.
    unlike = np.median([np.median([*np.abs(np.diff(one) / one[1:]), 1.0]) for one in periods])
    if unlike < 0.05:
        longest = max(periods, key=len)
        ends = [np.median(part) for part in np.array_split(longest, min(longest.size, 8))]
        return "a swept or stepped sine" if max(ends) > 1.2 * min(ends) else "a sine of one frequency"
    sizes = np.mean([[np.std(part) / np.std(row) for part in np.array_split(row, 16)] for row in rows], axis=0)
    still = max(sizes[0], sizes[-1]) < 0.2 * np.max(sizes)
    return "an earthquake, or another motion from rest to rest" if still else "random motion"


def channels_of(recording: Recording) -> list[Column]:
    """The columns beside time or frequency."""
    return [one for one in recording.columns if not is_abscissa(one.name)]


def coarse_lines(recording: Recording) -> list[str]:
    """That in words where a function has fewer than three lines within the half-power width of its largest peak."""
    counts = []
    for one in channels_of(recording) if recording.freq is not None else []:
        size, steps = np.abs(one.values), np.abs(np.diff(one.values))
        # Real numbers are coherences or magnitudes; spectra of random motion differ from line to line.
        if size.size < 2 or not np.any(np.imag(one.values)) or np.median(steps) > 0.5 * np.median(size):
            continue
        low, at = np.flatnonzero(~(size > np.max(size) / np.sqrt(2))), int(np.argmax(size))
        counts.append(int(min(low[low > at], default=size.size) - max(low[low < at], default=-1) - 1))
    fewest = min(counts, default=3)
    words = "in the half-power width of its sharpest peak, too few for its damping: export finer lines (longer blocks)"
    return [f"{recording.path}: {fewest} line{'s' * (fewest != 1)} {words}"] * (fewest < 3)


def _periods(row: Array) -> Array:
    """Samples between successive crossings of zero upwards, by lines between samples."""
    at = np.flatnonzero((row[:-1] < 0) & (row[1:] >= 0))
    return np.diff(at + row[at] / (row[at] - row[at + 1]))
