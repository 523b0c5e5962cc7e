"""Model error: what records hold beside noise that no structure of constant mass, stiffness and damping makes of them.

The model misses the records by more than their noise, or tests that were not fitted are predicted badly or move
otherwise; frequencies that change are told in `sysid.assessment.checks.changing`.
"""

from __future__ import annotations

from collections.abc import Iterator

from sysid.assessment.checks.context import Context
from sysid.assessment.checks.noise_multiples import BEYOND
from sysid.finding import Finding, Severity
from sysid.measurement.in_time import peaks
from sysid.modal_analysis.misfit import without_transients_of

LEVEL = 1.25  # times the fitted levels, beyond which another is outside
_CUT = (
    "these are plain spectra of records that move at their ends, which hold transients too: take whole records "
    "(from_time's estimator='records')"
)


def beyond_noise(context: Context) -> Iterator[Finding]:
    """The model misses the records by more than their noise."""
    if context.outcome is None or (
        context.problem.stated.goal is not None and (context.named or not context.is_judged)
    ):
        return
    for miss in context.misses:
        if miss.times > BEYOND:
            yield Finding(
                "beyond noise", context.weight,
                f"the model misses {miss.record} by {'at least ' * miss.at_least}{miss.times:.2g} times {miss.whose} "
                f"noise ({100 * miss.share:.3g} %): what it leaves out is larger than what the instruments add",
                _CUT * miss.cut, numbers={"times": miss.times, "share": miss.share},
            )  # fmt: skip


def unpredicted_tests(context: Context) -> Iterator[Finding]:
    """A test that was not fitted is predicted worse than by a rigid body."""
    if not context.is_judged or context.named:
        return
    for i, test in enumerate(context.problem.stated.validation, start=1):
        residual = without_transients_of(test, context.end.structure).residual(context.end.structure)
        if residual > 1.0:
            yield Finding(
                "unpredicted", Severity.CONTRADICTS,
                f"test {i} that was not fitted is predicted worse ({100 * residual:.3g} % missed) than by saying that "
                "the sensors move with the table (100 %)",
                numbers={"test": float(i), "residual": residual},
            )  # fmt: skip


def other_levels(context: Context) -> Iterator[Finding]:
    """A test that was not fitted moves more or less than any that was."""
    problem = context.problem
    if context.outcome is None or not problem.formulation.fits_records:
        return
    fitted = peaks(problem.stated.measurement)
    for i, test in enumerate(problem.stated.validation, start=1):
        levels = peaks(test)
        if not (fitted and levels):
            continue
        if max(levels) > LEVEL * max(fitted) or max(levels) < min(fitted) / LEVEL:
            span = f"{max(fitted):.3g}" if len(fitted) == 1 else f"{min(fitted):.3g} to {max(fitted):.3g}"
            yield Finding(
                "level", Severity.NOTE,
                f"test {i} that was not fitted moves the sensors by up to {max(levels):.3g} m/s² against the base, the "
                f"fitted {'run' if len(fitted) == 1 else 'runs'} by {span} m/s²: what holds at one level need not "
                "hold at another",
                numbers={"test": float(i), "peak": float(max(levels)), "fitted": float(max(fitted))},
            )  # fmt: skip
