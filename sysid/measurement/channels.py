"""Gains and delays of channels: tolerances of gains that are stated, and records without errors that were found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.structure.structure import Array


def tolerance_of(test: Measurement) -> Array:
    """Tolerances of a test's gains: of its sensors, its base directions and its force, (n_sensors + 2 d,)."""
    given = (test.gain_std, test.n_sensors), (test.base_gain_std, test.n_base), (test.force_gain_std, test.n_base)
    return np.concatenate([np.zeros(count) if std is None else std for std, count in given])


def seen_at_sensors(test: Measurement) -> Array:
    """What each gain's error makes of the sensors' gains against the base, (n_sensors, n_sensors + 2 d).

    A sensor that moves with several base directions counts each by its part along the sensor's whole motion with them.
    """
    n, d = test.rigid_body.shape
    power = test.rigid_body * (test.rigid_body @ np.einsum("rif,rjf->ij", test.base, test.base.conj()).real)
    share = power / np.maximum(power.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    return np.hstack([np.eye(n), -share, np.zeros((n, d))])


def read_by_gains(test: Measurement) -> Array:
    """What errors of gains, in units of tolerances, make of the channels, (n_sensors [+ d], d, k), to first order.

    A sensor's ``G_ij u_j`` takes its own factor, and is less by that of the base; its modes' shapes are free to take
    it. A force takes that of its gain, and that of the base's, by which the loads of the modes are less: of any base
    direction the same. Gains without a tolerance are left out.
    """
    n, d = test.rigid_body.shape
    moves = np.zeros((n + d, d, n + 2 * d))
    i, j = np.arange(n), np.arange(d)
    moves[i, :, i] = 1.0
    moves[:n, j, n + j] = -1.0
    for kind in (1, 2):
        moves[n + j, :, kind * d - d + n + j] = 1.0
    tolerance = tolerance_of(test)
    kept = tolerance > 0
    if test.force is None:
        moves, kept[n + d :] = moves[:n], False
    return moves[..., kept] * tolerance[kept]


def without_gains(test: Measurement, errors: Array) -> Measurement:
    """The test with each record divided by one and the relative error of its gain, order as in `tolerance_of`.

    What tolerances were stated of them is gone. Functions for unit motion of the base stay so: they are per what the
    base recorded.
    """
    n, d = test.rigid_body.shape
    sensors, base, force = np.split(1 + errors[:, None], [n, n + d])
    run: Array = np.ones((test.n_runs, 1, 1))
    if test.has_unit_runs:
        run, base = base[:, None], np.ones((d, 1))
    read = lambda record, gain: None if record is None else record * run / gain  # noqa: E731
    return replace(
        test, response=test.response * run / sensors, base=test.base / base, force=read(test.force, force),
        response_std=read(test.response_std, np.abs(sensors)), force_std=read(test.force_std, np.abs(force)),
        gain_std=np.zeros(n), base_gain_std=np.zeros(d), force_gain_std=np.zeros(d),
    )  # fmt: skip


def without_constants(test: Measurement, constants: Array) -> Measurement:
    """The test without shares of the base's motion, (n_sensors, d), that a wrong gain, sign or axis adds to sensors.

    `constants` of its `WholeRecords` says so.
    """
    whole = test.whole and test.whole.less(constants)
    return replace(test, response=test.response - constants @ test.base, whole=whole)


def without_delays(test: Measurement, delays: Array) -> Measurement:
    """The test with each channel earlier by its delay, s: of the sensors, then, where there is one, of the force.

    Spectra of whole records are turned about: a record that begins earlier holds its beginning at its end. `taken` of
    its `WholeRecords` says so, and their model has the samples there for unknowns.
    """
    turn = np.exp(2j * np.pi * delays[:, None] * test.freq)
    force, whole = (None if test.force is None else test.force * turn[-1]), test.whole and test.whole.earlier(delays)
    return replace(test, response=test.response * turn[: test.n_sensors], force=force, whole=whole)
