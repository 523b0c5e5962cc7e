"""Steady tones that channels of whole records hold beside the motion, such as hum of the mains, however large this is.

About each line the outputs are the motion of the base and transients, times polynomials of frequency (a local
polynomial method, as of Schoukens and others, IEEE Trans. Instrum. Meas. 55 (2006) 353-364). Of the rest a sine of the
frequency v holds ``a / (w - v)``, a number in each channel. It is judged against what is left in the lines about it by
the covariance of all channels, in which modes and noise of the base, which move all of them alike, count for little. A
tone does not decay: where the pole of a mode explains the lines better there is none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.measurement.whole import WholeRecords
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import FALSE_ALARM, ROUND_OFF, beyond_chance


def with_steady_tones(
    whole: WholeRecords, freq: Array, own: NDArray[np.bool_], base: ComplexArray, outputs: ComplexArray
) -> WholeRecords:
    """Whole records with the tones that they hold: `WholeRecords.tones`.

    Parameters
    ----------
    whole : WholeRecords
    freq, own : (n_freq,), (runs, n_freq)
        Hz, and which lines each run has.
    base, outputs : (runs, channels, n_freq)
    """
    tones: list[float] = []
    for run, at in enumerate(own):
        for tone in _tones(freq[at], base[run][:, at], outputs[run][:, at]):
            tones += [tone] if all(abs(tone - one) > whole.spacing.max() / 2 for one in tones) else []
    return replace(whole, tones=tuple(tones))


def _tones(freq: Array, base: ComplexArray, outputs: ComplexArray, order: int = 1, most: int = 8) -> list[float]:
    """Tones of a run at even lines, Hz, the loudest first."""
    c, known = len(outputs), (order + 1) * (len(base) + 1)
    reach = known // 2 + c + 6
    near, middles = np.arange(-reach, reach + 1), np.arange(reach, freq.size - reach)
    if not middles.size or np.ptp(np.diff(freq)) > 0.01 * (freq[1] - freq[0]):
        return []
    spacing, loud, places = float(freq[1] - freq[0]), np.zeros(freq.size), np.arange(-0.45, 0.5, 0.1)
    chance = FALSE_ALARM / (places.size * middles.size)
    least = float(scipy.special.fdtri(2 * c, 2 * (near.size - known - c), 1 - chance))

    def about(at: NDArray[np.intp]) -> _Local:
        return _Local(near, base[:, at[:, None] + near], outputs[:, at[:, None] + near], order)

    for at in np.array_split(middles, 1 + middles.size // 2000):
        local = about(at)
        loud[at] = np.max([local.times(place) for place in places], axis=0)
    found: list[float] = []
    for line in np.argsort(-loud):
        if loud[line] < 0.3 * least or len(found) == most:
            break
        if any(abs(freq[line] - one) < reach * spacing for one in found):
            continue
        local = about(np.array([line]))
        place = local.loudest()
        if local.times(place)[0] > least and local.is_steady(place):
            found.append(float(freq[line] + place * spacing))
    return found


class _Local:
    """What the motion of the base and transients leave of the outputs in lines about some, (lines, near, c)."""

    def __init__(self, near: NDArray[np.intp], base: ComplexArray, outputs: ComplexArray, order: int) -> None:
        power = np.vander(near / near[-1], order + 1)
        moved = np.moveaxis(np.concatenate([np.ones((1, *base.shape[1:])), base]), 0, -1)  # (lines, near, 1 + d)
        A = (moved[..., None] * power[:, None]).reshape(*moved.shape[:2], -1)
        size = np.linalg.norm(A, axis=1, keepdims=True)
        self.Q = np.linalg.qr(A / np.where(size > 0, size, 1.0))[0]
        left = np.moveaxis(outputs, 0, -1)
        left = left - self.Q @ (self.Q.conj().swapaxes(1, 2) @ left)
        size = np.linalg.norm(left, axis=1, keepdims=True)
        self.near, self.left = near, left / np.where(size > 0, size, 1.0)
        gram = self.left.conj().swapaxes(1, 2) @ self.left
        self.inverse = np.linalg.inv(gram + ROUND_OFF * np.eye(gram.shape[1]))
        self.freedom = near.size - self.Q.shape[2]

    def share(self, place: complex) -> Array:
        """Share of what is left that a sine at a place among the lines, or a pole, explains, (lines,).

        In the combination of the channels that shows it most.
        """
        shape = (-1.0) ** self.near * np.sinc(self.near - place)
        shape = shape - np.einsum("lkp,lp->lk", self.Q, np.einsum("lkp,k->lp", self.Q.conj(), shape))
        seen = np.einsum("lk,lkc->lc", shape / np.linalg.norm(shape, axis=1)[:, None], self.left.conj())
        share = np.einsum("lc,lcd,ld->l", seen.conj(), self.inverse, seen).real
        return np.asarray(np.clip(share, 0.0, 1 - ROUND_OFF))

    def times(self, place: complex) -> Array:
        """Hotelling's T² of that as F of twice as many numbers as channels, and twice those that are left, (lines,)."""
        share, c = self.share(place), self.left.shape[2]
        return np.asarray(share / (1 - share) * (self.freedom - c) / c)

    def loudest(self) -> float:
        """The place near the first of the lines at which a sine explains most."""
        best = scipy.optimize.minimize_scalar(
            lambda place: -float(self.times(place)[0]), bounds=(-0.7, 0.7), method="bounded", options={"xatol": 1e-5}
        )
        return float(best.x)

    def is_steady(self, place: float, slow: float = 0.1) -> bool:
        """True where no pole that decays or grows is likelier beyond chance, and one that does so by `slow` is less."""

        def likelihood(pole: complex) -> float:
            return -self.freedom * float(np.log1p(-self.share(pole)[0]))

        free = lambda x: -likelihood(complex(x[0], x[1]))  # noqa: E731
        best = -min(scipy.optimize.minimize(free, (place, side), method="Nelder-Mead").fun for side in (slow, -slow))
        other = max(likelihood(complex(place, side)) for side in (slow, -slow))
        return best - likelihood(place) < beyond_chance(1) / 2 < likelihood(place) - other
