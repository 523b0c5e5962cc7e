"""Transients that a known structure makes of whole records: what a test that was not fitted is predicted beside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.response import stacked
from sysid.structure.structure import Array, ComplexArray, Structure


def without_transients_of(test: Measurement, structure: Structure) -> Measurement:
    """Whole records with the transients taken off that a structure can have had, by least squares; others as they are.

    Changes of displacement q and velocity v over a run make ``Z^-1 (f + i w g)`` of the degrees of freedom, with Z the
    dynamic stiffness, ``f = K v`` and ``g = K q + C v``: two real numbers a degree of freedom and run, whatever the
    damping. Traces of sampling and detrending are real multiples of 1, i w and 1 / (i w) a channel and run,
    also of one at rest at both ends.
    """
    if test.whole is None:
        return test
    n = structure.n
    w = 2 * np.pi * test.freq
    M, K = structure.mass[:n, :n], structure.stiffness[:n, :n]
    square, once = (w**2)[:, None, None], w[:, None, None]
    X = np.linalg.inv(-square * M + 1j * once * structure.damping + K)  # (L, n, n)
    both = np.concatenate([X, 1j * once * X], axis=2)
    transients = structure.recovery @ both
    if test.force is not None:
        push = M @ structure.rigid_body_dofs + structure.mass[:n, n:]
        transients = np.concatenate([transients, push.T @ both], axis=1)
    left = test.response - np.einsum("sd,rdf->rsf", test.rigid_body, test.base) - test.predict(structure)
    if test.force is not None:
        left = np.concatenate([left, test.force - test.predict_force(structure)], axis=1)
    taken = np.zeros_like(left)
    transients = np.moveaxis(transients, 0, -1)  # (c, 2 n, L)
    for run, (lines, rest) in enumerate(zip(test.own_lines, test.whole.at_rest, strict=True)):
        of_ends = transients[:, :0] if rest else transients
        taken[run][:, lines] = _fitted(left[run][:, lines], of_ends[..., lines], w[lines] / w[-1])
    s = test.n_sensors
    force = None if test.force is None else test.force - taken[:, s:]
    return replace(test, whole=None, response=test.response - taken[:, :s], force=force)


def _fitted(left: ComplexArray, transients: ComplexArray, unit: Array) -> ComplexArray:
    """The part of what is left (c, L) that transients (c, p, L) and traces of each channel explain."""
    _, p, lines = transients.shape
    traces = stacked(np.stack([np.ones(lines) + 0j, 1j * unit, -1j / unit]))  # (2 L, 3)
    Q = np.linalg.qr(traces)[0]
    size = np.linalg.norm(left, axis=1)
    size[size == 0] = 1.0
    rows = np.array([stacked(part) for part in transients]) / size[:, None, None]  # (c, 2 L, p)
    wanted = stacked(left).T / size[:, None]  # (c, 2 L)
    plain_rows, plain = rows - Q @ (Q.T @ rows), wanted - (wanted @ Q) @ Q.T
    scale = np.linalg.norm(plain_rows, axis=(0, 1))
    scale[scale == 0] = 1.0
    x = np.linalg.lstsq((plain_rows / scale).reshape(plain.size, p), plain.ravel(), rcond=1e-10)[0] / scale
    explained = rows @ x
    explained = (explained + (wanted - explained) @ Q @ Q.T) * size[:, None]
    return explained[:, :lines] + 1j * explained[:, lines:]
