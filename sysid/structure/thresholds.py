"""Limits that all rooms share: what is round-off, what counts as the same, and what noise does by chance.

Round-off and the same are told apart by size, each limit relative to what is compared:

======================  ===================================================================================
`round_off` (n terms)   one sum or decomposition of exact numbers: ranks, eigenvalues
`ROUND_OFF`             a result that came through several of them, each of a condition up to 1e6
`EXACT`                 the root of it in one sum: a residual whose square is lost in a sum of squares
`NEGLIGIBLE`            results of iterations, which end there; parts of a whole that are none
======================  ===================================================================================
"""

from __future__ import annotations

EPSILON = 2.0**-52  # distance from 1 to the next number
ROUND_OFF = 1e-9  # relative error of what came through several decompositions: a number below it is zero
EXACT = 1e-8  # relative residual, or asymmetry, of what is exact
NEGLIGIBLE = 1e-6  # relative difference up to which two results are one; relative size of a part that counts as none


def round_off(terms: int) -> float:
    """Relative error of one sum, or of the eigenvalues and singular values of a matrix, of so many terms."""
    return 10 * terms * EPSILON
