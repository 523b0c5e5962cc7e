"""Modes that were let follow their amplitude: whether they do, and how far."""

from __future__ import annotations

from collections.abc import Iterator

from sysid.assessment.checks.context import Context
from sysid.finding import Finding, Severity
from sysid.structure.thresholds import LIKELY


def laws_of_amplitude(context: Context) -> Iterator[Finding]:
    """Modes do not follow their amplitude, or what they do is not determined, though this was asked for."""
    asked = context.problem.stated.amplitude
    if asked is None:
        return
    for mode, law in zip(asked.modes, context.modal.laws, strict=False):
        low, high = law.levels
        numbers = {"mode": float(mode), "lowest": low, "highest": high}
        (f, zeta), (std, of_damping) = law.change()
        numbers |= {"change of frequency": f, "its deviation": std, "change of damping": zeta}
        over = f"over the levels tested ({low:.2g} to {high:.2g} m/s²)"
        if law.is_certain:
            yield Finding(
                "amplitude law", Severity.NOTE,
                f"mode {mode} follows its amplitude: from {low:.2g} to {high:.2g} m/s² its frequency changes by "
                f"{100 * f:.2g} % (+- {100 * LIKELY * std:.2g} %) and its damping ratio by {100 * zeta:.2g} % of "
                f"critical (+- {100 * LIKELY * of_damping:.2g})", numbers=numbers,
            )  # fmt: skip
        elif LIKELY * std < law.ratio:  # less than half the half-power width
            yield Finding(
                "linear", Severity.NOTE,
                f"mode {mode} is linear {over}: its frequency changes by less than "
                f"{100 * (abs(f) + LIKELY * std):.2g} %",
                numbers=numbers,
            )  # fmt: skip
        else:
            yield Finding(
                "amplitude open", Severity.CAUTION,
                f"whether mode {mode} follows its amplitude is not determined {over}: a change of its frequency is "
                f"known to +- {100 * LIKELY * std:.2g} %, more than half of its half-power width",
                "test at several levels, the lowest a tenth of the highest, each for longer", numbers=numbers,
            )  # fmt: skip
