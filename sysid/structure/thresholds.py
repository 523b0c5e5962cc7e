"""Limits that all rooms share: what is round-off, what counts as the same, and what noise does by chance.

Round-off and the same are told apart by size, each limit relative to what is compared:

======================  ===================================================================================
`round_off` (n terms)   one sum or decomposition of exact numbers: ranks, eigenvalues
`ROUND_OFF`             a result that came through several of them, each of a condition up to 1e6
`EXACT`                 the root of it in one sum: a residual whose square is lost in a sum of squares
`NEGLIGIBLE`            results of iterations, which end there; parts of a whole that are none
======================  ===================================================================================

Chance is told by one rate of false alarms, shared by all that are looked at together (Bonferroni), and by the degrees
of freedom: `beyond_chance` for sums of squares, `most_deviations` for one number, `largest_modulus` for a complex one.
"""

from __future__ import annotations

import math
import sys

import scipy

EPSILON = 2.0**-52  # distance from 1 to the next number
ROUND_OFF = 1e-9  # relative error of what came through several decompositions: a number below it is zero
EXACT = 1e-8  # relative residual, or asymmetry, of what is exact
NEGLIGIBLE = 1e-6  # relative difference up to which two results are one; relative size of a part that counts as none

UNEXPLAINED = 0.5  # relative residual above which a model explains nothing of the records
AS_GOOD = 1.02  # times the misfit of another fit, up to which a fit is as good
FREE = 1.05  # times what free residues leave at the same poles, up to which a fit is where it can be
MENDED = 0.3  # of the misfit, that mended records may leave
SAME_ANSWER = 1e-3  # of an unknown's or a matrix's size: answers nearer to each other are one
OTHER_ANSWER = 1e-2  # of the same, from which two answers are two

FALSE_ALARM = 1e-3  # chance that one check accuses a right test of anything
CANDIDATES = 10**9  # that the fits of one search look at, at most: poles of any frequency and damping, lines, channels
COVERAGE = 0.95  # of intervals
LIKELY = 1.959963984540054  # standard deviations on either side that have this coverage


def round_off(terms: int) -> float:
    """Relative error of one sum, or of the eigenvalues and singular values of a matrix, of so many terms."""
    return 10 * terms * EPSILON


def beyond_chance(freedom: float, at_once: int = 1, chance: float = FALSE_ALARM) -> float:
    """Sum of squares of so many numbers of noise, in units of its variance, that chance does not reach.

    Of `freedom` degrees, or none; `at_once` such sums are looked at, and `chance` is that one of them is larger all the
    same.
    """
    least = sys.float_info.min  # for nothing to sum, of which the sum is zero
    return float(scipy.special.chdtri(max(freedom, least), chance / max(at_once, 1)))


def most_deviations(at_once: int = 1, chance: float = FALSE_ALARM) -> float:
    """Standard deviations, either way, that none of so many numbers of noise is off by."""
    return math.sqrt(beyond_chance(1, at_once, chance))


def largest_modulus(at_once: int = 1) -> float:
    """Modulus that none of so many complex numbers of noise reaches, in units of ``sqrt(E|e|²)``."""
    return math.sqrt(beyond_chance(2, at_once) / 2)
