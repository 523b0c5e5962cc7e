"""Frequencies, damping ratios and unknowns of a result, by the names that tables give them."""

from __future__ import annotations

import numpy as np

from sysid.results.identification import Identification
from sysid.structure.structure import Array

FREQUENCY, RATIO = "frequency, Hz", "damping ratio"


def quantities(result: Identification) -> dict[str, float]:
    """Frequencies, damping ratios and unknowns that mean something by themselves, by label; none fixed ones.

    Damping ratios are none of them where nothing that is fitted tells of the damping.
    """
    s, values = result.structure, result.values
    free = [v.name for v in result.facts.unknowns if not (v.fixed or v.is_ratio) and v.name in values]
    return labelled(s.natural_frequencies, result.identified_ratios, {name: values[name] for name in free})


def labelled(frequencies: Array, ratios: Array, unknowns: dict[str, Array]) -> dict[str, float]:
    """All numbers by their names, entries of an unknown from 1, column by column; without ratios that are NaN."""
    by_label = {label(i, FREQUENCY): float(f) for i, f in enumerate(frequencies)}
    by_label |= {label(i, RATIO): float(ratio) for i, ratio in enumerate(ratios) if not np.isnan(ratio)}
    for name, value in unknowns.items():
        entries = np.ravel(value, order="F").tolist()
        by_label |= {name if len(entries) == 1 else f"{name} {i + 1}": entry for i, entry in enumerate(entries)}
    return by_label


def label(mode: int, what: str) -> str:
    """Name of a mode's quantity; modes are counted from 0 here, and from 1 there."""
    return f"mode {mode + 1}: {what}"
