"""Modes whose frequency and damping follow an amplitude: the law, and its motion in time with sensitivities.

A mode of frequency w and damping ratio zeta moves by ``q'' + 2 zeta(A) w(A) q' + w(A)² q = -load``, with
``w(A) = w0 (1 - a (A/A0)^p)`` and ``zeta(A) = zeta0 + b (A/A0)^q``, A the envelope of its own acceleration,
``w(A)² sqrt(q² + (q'/w(A))²)``, times the size of its shape at a sensor, or that of another mode, as where joints that
all modes move slip or harden by what the largest does; A0 is a level at which a and b are read.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, refuse, whole_number
from sysid.structure.simulation import spline_of
from sysid.structure.thresholds import beyond_chance

Array = NDArray[np.floating[Any]]

# Of w0, as it is over the fastest; a damping ratio: no law leads beyond, so that any step of a fit can be tried.
SLOWEST, MOST_DAMPED = 0.2, 0.9
OF_FREQUENCY, OF_DAMPING = (0.5, 1.0, 2.0), (0.5, 1.0, 2.0, -1.0)


@dataclass(frozen=True)
class AmplitudeLaw:
    """Modes whose frequency and damping follow their own amplitude: what is stated of it.

    Parameters
    ----------
    modes : sequence of int or "auto"
        Numbers of these modes, from 1, by frequency within the lines; "auto" takes the first and, where it follows its
        amplitude, each further one that is likelier with a law than without.
    exponents : (float, float) or "auto"
        Of the fall of the frequency (1/2, 1 or 2) and of the rise of the damping ratio (-1, as of friction, 1/2, 1 or
        2) with the level; "auto" takes the likeliest of each mode.

    Examples
    --------
    >>> AmplitudeLaw(modes=[1])
    AmplitudeLaw(modes=(1,), exponents='auto')
    """

    modes: Sequence[int] | Literal["auto"] = "auto"
    exponents: tuple[float, float] | Literal["auto"] = "auto"

    def __post_init__(self) -> None:
        if not isinstance(self.modes, str) or self.modes != "auto":
            if not isinstance(self.modes, list | tuple) or not self.modes:
                raise InputError(f"AmplitudeLaw: modes = {self.modes!r}; give 'auto', or numbers from 1: modes=[1]")
            modes = tuple(whole_number("AmplitudeLaw: a mode", mode, at_least=1) for mode in self.modes)
            refuse((len(set(modes)) < len(modes), f"AmplitudeLaw: modes = {list(modes)} names a mode twice"))
            object.__setattr__(self, "modes", modes)
        if isinstance(self.exponents, str) and self.exponents == "auto":
            return
        sound = isinstance(self.exponents, list | tuple) and len(self.exponents) == 2
        sound = sound and self.exponents[0] in OF_FREQUENCY and self.exponents[1] in OF_DAMPING
        each = f"one of {OF_FREQUENCY} for the frequency and one of {OF_DAMPING} for the damping"
        refuse((not sound, f"AmplitudeLaw: exponents = {self.exponents!r}; give 'auto', or {each}"))
        object.__setattr__(self, "exponents", (float(self.exponents[0]), float(self.exponents[1])))

    def to_tree(self) -> dict[str, Any]:
        """Give the arguments of the constructor."""
        return {name: value if value == "auto" else list(value) for name, value in vars(self).items()}


class LawForm(NamedTuple):
    """Form of a law: exponents of the frequency's fall and of the damping's rise, and the level A0, m/s²."""

    of_frequency: float
    of_damping: float
    level: float

    @property
    def size(self) -> int:
        """Numbers of such a law: a and b."""
        return 2

    def at(self, A: ca.SX, omega: ca.SX, ratio: ca.SX, values: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Frequency and damping ratio at level A."""
        unit = A / self.level
        w = omega * (1 - values[0] * _power(unit, self.of_frequency))
        zeta = ratio + values[1] * _power(unit, self.of_damping)
        w = ca.fmin(ca.fmax(w, SLOWEST * omega), omega / SLOWEST)
        return w, ca.fmin(ca.fmax(zeta, 0.0), MOST_DAMPED)


def _power(unit: ca.SX, exponent: float) -> ca.SX:
    """A power of a level that is finite, and smooth, at rest."""
    if exponent == 2:
        return unit**2
    return (unit**2 + (1e-12 if exponent > 0 else 1e-4)) ** (exponent / 2)


@dataclass(frozen=True, eq=False)
class FittedLaw:
    """Law of one mode, as fitted.

    Attributes
    ----------
    frequency, ratio : float
        Hz; damping ratio: both at rest.
    sensor : int
        Index of the sensor at which the level counts.
    form : LawForm
    values : (k,)
        a, b of the form.
    levels : (float, float)
        m/s², that the mode moved at: all but a twentieth of the time above the first, never above the second.
    covariance : (2 + k, 2 + k)
        Of the logarithms of frequency and ratio, and of the values.
    likelier : bool
        Whether the fit with the law is likelier than that without, beyond chance.
    mode : int
        Index of its mode among those of the structure that holds it.
    followed : float
        Hz at rest, of the mode whose level counts; zero where it is its own.
    level_of : int
        Index of that mode, as `mode`.
    """

    frequency: float
    ratio: float
    sensor: int
    form: LawForm
    values: Array
    levels: tuple[float, float]
    covariance: Array
    likelier: bool
    mode: int = 0
    followed: float = 0.0
    level_of: int = 0

    @property
    def is_certain(self) -> bool:
        """True where chance does not make such a law."""
        covariance = self.covariance[2:, 2:]
        size = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
        unit = self.values / size
        away = float(unit @ np.linalg.pinv(covariance / np.outer(size, size), hermitian=True) @ unit)
        return self.likelier and away > beyond_chance(self.values.size)

    def mode_among(self, frequencies: Array, within: float = 0.1, *, followed: bool = False) -> int | None:
        """Number of the nearest of some modes, Hz, (m,); None where it is not `within` this share of the law's.

        With `followed` that of the mode whose level counts.
        """
        apart = np.abs(frequencies / ((followed and self.followed) or self.frequency) - 1)
        return min(np.flatnonzero(apart <= within).tolist(), key=apart.__getitem__, default=None)

    def at(self, level: float) -> tuple[float, float]:
        """Frequency, Hz, and damping ratio at a level, m/s²."""
        w, zeta = self.form.at(ca.SX(level), ca.SX(self.frequency), ca.SX(self.ratio), ca.SX(ca.DM(self.values)))
        return float(w), float(zeta)

    @property
    def formula(self) -> str:
        """Frequency, Hz, and damping ratio by the level A, m/s², in words."""
        (a, b), (p, q, top) = self.values, self.form
        fall, rise = (f"{value:.3g} (A/{top:.3g})^{exponent:g}" for value, exponent in ((a, p), (b, q)))
        text = f"{self.frequency:.5g} (1 - {fall}) Hz and {self.ratio:.3g} + {rise}"
        return text.replace("- -", "+ ").replace("+ -", "- ")

    def reaches(self, low: float, high: float) -> bool:
        """True where the mode is between two frequencies, Hz, at some of the levels that it moved at."""
        ends = [self.at(level)[0] for level in self.levels]
        return min(ends) <= high and max(ends) >= low

    def is_beyond(self, level: float) -> bool:
        """True of a level, m/s², that the mode did not move at."""
        return not self.levels[0] <= level <= self.levels[1]

    def changes_at(self, level: float, omega: float, ratio: float) -> tuple[float, float]:
        """``w² - w0²`` and ``2 (zeta w - zeta0 w0)`` at a level, of a mode of `omega`, rad/s, and `ratio` at rest."""
        frequency, damping = self.at(level)
        w, zeta = omega * frequency / self.frequency, min(max(ratio + damping - self.ratio, 0.0), MOST_DAMPED)
        return w**2 - omega**2, 2 * (zeta * w - ratio * omega)

    def change(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Relative change of the frequency, and change of the damping ratio, over the levels, with their deviations."""
        low, high = self.levels
        return self._with_deviations(lambda at: ca.vertcat(at(high)[0] / at(low)[0] - 1, at(high)[1] - at(low)[1]))

    def deviations_at(self, level: float) -> tuple[float, float]:
        """Standard deviations of both, to first order."""
        return self._with_deviations(lambda at: ca.vertcat(*at(level)))[1]

    def _with_deviations(
        self, of_levels: Callable[[Callable[[float], tuple[ca.SX, ca.SX]]], ca.SX]
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """Two numbers that follow from frequency and damping at some levels, and their deviations, to first order."""
        x = ca.SX.sym("x", 2 + self.values.size)
        both = of_levels(lambda level: self.form.at(ca.SX(level), ca.exp(x[0]), ca.exp(x[1]), x[2:]))
        function = ca.Function("both", [x], [both, ca.jacobian(both, x)])
        values, J = (part.full() for part in function(np.append(np.log([self.frequency, self.ratio]), self.values)))
        first, second = np.sqrt(np.maximum(np.diag(J @ self.covariance @ J.T), 0.0))
        return (float(values[0, 0]), float(values[1, 0])), (float(first), float(second))


@functools.cache
def _functions(form: LawForm, given: int = 0) -> tuple[ca.Function, ca.Function]:
    """First state and one step of the motion of a mode, under a load that is linear between samples.

    The numbers of the mode are ``(log w0, log zeta0, log size, law)``; a state is ``(q, q', A)``. The law moves the
    level that it is of: Newton's steps find it. A step is of fourth order (Magnus; Blanes, Casas, Oteo and Ros, Physics
    Reports 470 (2009) 151-238). It has the mean over the step of w² and that of 2 zeta w, by Simpson's rule; that they
    are other ones at its end than at its beginning changes the velocity before it, and back after it.
    The first function takes ``(q, q')`` and these numbers. The second takes a state, the load at both ends of the step,
    the `given` level at its end, its length and these numbers, and gives the next state and ``-2 zeta w q' - w² q`` at
    its beginning.
    """
    p, h, end = ca.SX.sym("p", 3 + form.size), ca.SX.sym("h"), ca.SX.sym("A", given)
    omega, ratio, size = ca.exp(p[0]), ca.exp(p[1]), ca.exp(p[2])

    def pole(A: ca.SX) -> tuple[ca.SX, ca.SX]:
        return form.at(A, omega, ratio, p[3:])

    def of_acceleration(z: ca.SX, w: ca.SX) -> ca.SX:
        return size * w * ca.sqrt((w * z[0]) ** 2 + z[1] ** 2 + (1e-12 * form.level / (size * omega)) ** 2)

    A, at = ca.SX.sym("near"), ca.SX.sym("at", 2)
    off = A - of_acceleration(at, pole(A)[0])
    # Newton's step to the level that the law is of and lowers itself; of one that rises the slope may vanish.
    closer = ca.Function("closer", [A, at, p], [ca.fmax(A - off / ca.fmax(ca.jacobian(off, A), 0.2), 0.0)])

    begin = ca.SX.sym("begin", 2)
    near = of_acceleration(begin, omega)
    for _ in range(8):
        near = closer(near, begin, p)
    first = ca.Function("first", [begin, p], [ca.vertcat(begin, near)])
    state, load = ca.SX.sym("z", 3), ca.SX.sym("u", 2)
    middle, then = (state[2] + end) / 2 if given else state[2], end
    if not given:
        half = ca.vertcat(load[0], ca.sum1(load) / 2)
        for _ in range(2):
            middle = closer(middle, _step(state[:2], half, h / 2, *pole((state[2] + middle) / 2)), p)
        then = closer(middle, _step(state[:2], load, h, *pole(middle)), p)
    # Of q and of q' in the restoring acceleration, at the beginning, in the middle and at the end.
    factors = [ca.vertcat(w**2, 2 * zeta * w) for w, zeta in map(pole, (state[2], middle, then))]
    mean, change = (factors[0] + 4 * factors[1] + factors[2]) / 6, h / 12 * (factors[2] - factors[0])
    start = ca.vertcat(state[0], state[1] + ca.dot(change, state[:2]))
    after = _step(start, load, h, ca.sqrt(mean[0]), mean[1] / (2 * ca.sqrt(mean[0])))
    after = ca.vertcat(after[0], after[1] - ca.dot(change, after))
    restoring = -ca.dot(factors[0], state[:2])
    last = end if given else closer(then, after, p)
    step = ca.Function("step", [state, load, end, h, p], [ca.vertcat(after, last), restoring])
    return first, step


def _step(z: ca.SX, load: ca.SX, h: ca.SX, w: ca.SX, zeta: ca.SX) -> ca.SX:
    """Motion after a step of constant frequency and damping, under a load that is linear in it."""
    damped, slope = w * ca.sqrt(1 - zeta**2), (load[1] - load[0]) / h
    fall, turn, lift = ca.exp(-zeta * w * h), ca.cos(damped * h), ca.sin(damped * h)
    forced, then = (-one / w**2 + 2 * zeta * slope / w**3 for one in ca.vertsplit(load))
    away, speed = z[0] - forced, z[1] + slope / w**2
    q = fall * (turn * away + lift / damped * (speed + zeta * w * away)) + then
    v = fall * (turn * speed - lift / damped * (w**2 * away + zeta * w * speed)) - slope / w**2
    return ca.vertcat(q, v)


@functools.cache
def _recursion(form: LawForm, steps: int, directions: int, given: int) -> ca.Function:
    """The motion over all steps, with its level; with `directions` of the base, their derivatives too.

    These are by the first state, by the participation in each direction, by the numbers of the mode, and by those that
    a level depends upon which is given at each step's end: it and its derivatives are so many rows, none of an own one.
    """
    ends, q = min(given, 1), 3 + form.size
    step = _functions(form, ends)[1]
    state, load, h, p = (ca.SX.sym(*one) for one in (("z", 3), ("u", 2), ("h", 1), ("p", q)))
    level = ca.SX.sym("A", given)
    after, restoring = step(state, load, level[:ends], h, p)
    if not directions:
        both = [after, ca.vertcat(restoring, state[2])]
        return ca.Function("once", [state, load, level, h, p], both).mapaccum("motion", steps)
    others = max(given - 1, 0)
    moves, motions = ca.SX.sym("S", 3, 2 + directions + q + others), ca.SX.sym("U", 2, directions)
    of_inputs = ca.vertcat(
        moves,
        ca.horzcat(ca.SX.zeros(2, 2), motions, ca.SX.zeros(2, q + others)),
        ca.horzcat(ca.SX.zeros(q, 2 + directions), ca.SX.eye(q), ca.SX.zeros(q, others)),
        ca.horzcat(ca.SX.zeros(ends, 2 + directions + q), ca.reshape(level[1:], ends, others)),
    )
    # In one piece: by its four rows, not by its many columns.
    by_inputs = ca.jacobian(ca.vertcat(after, restoring), ca.vertcat(state, load, p, level[:ends]))
    moved = by_inputs @ of_inputs
    rows = ca.vertcat(ca.horzcat(restoring, moved[3, :]), ca.horzcat(state[2], moves[2, :]))
    outputs = ca.cse([ca.horzcat(after, moved[:3, :]), rows])
    once = ca.Function("once", [ca.horzcat(state, moves), load, level, motions, h, p], outputs)
    return once.mapaccum("motion", steps)


def motion(
    form: LawForm, load: Array, step: float, numbers: Array, initial: Array, motions: Array | None = None,
    level: Array | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """Restoring acceleration and level of a mode at all samples of its load, and their derivatives.

    Parameters
    ----------
    load : (n,)
        Participations times the motion of the base, m/s²; linear from sample to sample.
    step : float
        s.
    numbers : (3 + form.size,)
        Logarithms of frequency, rad/s, damping ratio and size of the shape, and the law's.
    initial : (2,)
        Displacement and velocity at the first sample.
    motions : (d, n), optional
        Of the base, for derivatives by participations.
    level : (1 or 1 + k, n), optional
        Of another mode, m/s², which counts in place of its own; with `motions`, then its derivatives by k numbers.

    Returns
    -------
    two of (1, n) or, with `motions`, (3 + d + numbers.size + k, n)
        ``-2 zeta w q' - w² q``, and the level, m/s²; then their derivatives by the initial state, by participations, by
        the numbers, and by those of the given level.
    """
    # In units of A0: one function serves laws that are alike but for it.
    top, form, d = form.level, form._replace(level=1.0), 0 if motions is None else len(motions)
    numbers = numbers - np.log(top) * (np.arange(numbers.size) == 2)
    first, given = _functions(form)[0], np.zeros((0, load.size)) if level is None else level / top
    state = np.zeros((3, 1 if motions is None else 3 + d + numbers.size + max(len(given) - 1, 0)))
    state[:, :1] = first(initial, numbers)
    beside = []
    if motions is not None:
        by_initial, by_numbers = first.jacobian()(initial, numbers, state[:, :1])
        state[:, 1:3], state[:, 3 + d : 3 + d + numbers.size] = by_initial.full(), by_numbers.full()
        beside = [np.stack([motions, _next(motions)]).transpose(0, 2, 1).reshape(2, -1)]  # a pair of rows a step
    if level is not None:
        state[2] = 0.0
        state[2, [0, *range(state.shape[1] - len(given) + 1, state.shape[1])]] = given[:, 0]
    # Past CasADi's matrices: their conversion takes a third of the time of a fit with laws.
    buffer, run = _recursion(form, load.size, d, len(given)).buffer()
    steps, rows = np.full(load.size, step), np.empty((load.size, state.shape[1], 2))
    parts = state, np.stack([load, _next(load)]), _next(given), *beside, steps, np.tile(numbers, load.size)
    held = [np.ravel(part, order="F").data for part in parts]
    for i, part in enumerate(held):
        buffer.set_arg(i, part)
    buffer.set_res(1, rows.data)
    run()
    return rows[..., 0].T, top * rows[..., 1].T


def _next(rows: Array) -> Array:
    """The same a sample later, (..., n); the last stays."""
    return np.concatenate([rows[..., 1:], rows[..., -1:]], axis=-1)


def follow_laws(
    modal: Array, laws: Sequence[FittedLaw], poles: Array, shapes: Array, loads: Array, rate: float, initial: Array,
    per_period: float = 96.0,
) -> None:  # fmt: skip
    """Put accelerations of modes that follow laws in the place of those of linear ones, m/s², (m, n).

    Loads, m/s², (m, n), are the splines through their samples by which linear modes move, straight over steps of
    `per_period` in a period. `poles` are circular frequencies, rad/s, and damping ratios, (2, m), `shapes` those at the
    sensors, (s, m); `initial`, (2, m), as in `motion`.
    """

    def moved(law: FittedLaw, times: int, level: Array | None = None) -> tuple[Array, Array]:
        k = law.mode
        numbers = np.concatenate([np.log(np.abs([*poles[:, k], shapes[law.sensor, k]])), law.values])
        fine = spline_of(loads[[k]])(np.arange((loads.shape[1] - 1) * times + 1) / times)[:, 0]
        return motion(law.form, fine, 1 / (rate * times), numbers, initial[:, k], level=level)

    with_law = {law.mode: law for law in laws}
    for law in laws:
        times = max(int(np.ceil(per_period * max(poles[0, [law.mode, law.level_of]]) / (2 * np.pi) / rate)), 1)
        first = with_law.get(law.level_of, replace(law, mode=law.level_of, values=0 * law.values))
        level = None if first is law else moved(first, times)[1]
        modal[law.mode] = moved(law, times, level)[0][0, ::times] - loads[law.mode]


def laws_to_tree(laws: Sequence[FittedLaw]) -> list[dict[str, Any]] | None:
    """Laws as dictionaries, for `laws_from_tree`; None without any."""
    return [{**vars(law), "form": np.array(law.form), "levels": np.array(law.levels)} for law in laws] or None


def laws_from_tree(tree: list[dict[str, Any]] | None) -> tuple[FittedLaw, ...]:
    """Laws that `laws_to_tree` made a tree of."""
    return tuple(
        FittedLaw(**{**law, "form": LawForm(*law["form"].tolist()), "levels": tuple(law["levels"].tolist())})
        for law in tree or ()
    )
