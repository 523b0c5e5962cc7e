"""The virtual test of a structure: its spectra under unit base motion, with noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import as_float, check_frequencies, flag, instance, random_generator
from sysid.measurement.measurement import Measurement, unit_runs
from sysid.structure.sensor import without_delay
from sysid.structure.structure import Array, ComplexArray, Structure


def simulate(
    structure: Structure,
    freq: ArrayLike,
    *,
    noise: float = 0.0,
    force: bool = False,
    rng: int | np.random.Generator | None = None,
    base_axes: str | Sequence[str] | None = None,
) -> Measurement:
    """The virtual test: d runs of unit base motion, noise on the responses (and force) only.

    Parameters
    ----------
    structure : Structure
    freq : array_like, shape (n_freq,)
        Hz.
    noise : float
        Circular complex noise with ``E|e|² = noise² mean|record|²``, the mean taken over all runs,
        channels and lines; responses and force apart.
    force : bool
        Record the base force too.
    rng : int, numpy Generator or None
    base_axes : str or sequence of str, optional
        Names of the base directions, as in `Measurement`.

    Returns
    -------
    Measurement
        Its standard deviations are set where `noise` is not zero. The *noise floor* of a draw is
        ``measurement.residual(structure)``.
    """
    instance("structure", structure, Structure)
    noise = as_float("noise", noise, "a finite fraction >= 0", at_least=0)
    lines = check_frequencies(freq)
    random = random_generator(rng)
    response, response_std = _with_noise(np.moveaxis(structure.transmissibility(lines), 1, 0), noise, random)
    base_force = force_std = None
    if flag("force", force):
        base_force, force_std = _with_noise(np.moveaxis(structure.base_force(lines), 1, 0), noise, random)
    options: Any = {"sensors": without_delay(structure.sensors), "base_axes": base_axes}
    return Measurement(
        lines, unit_runs(structure.n_base, lines.size), response, rigid_body=structure.rigid_body,
        force=base_force, response_std=response_std, force_std=force_std, **options,
    )  # fmt: skip


def _with_noise(record: ComplexArray, noise: float, random: np.random.Generator) -> tuple[ComplexArray, Array | None]:
    if noise == 0:
        return record, None
    std = noise * np.sqrt(np.mean(np.abs(record) ** 2))
    error = random.standard_normal(record.shape) + 1j * random.standard_normal(record.shape)
    return record + error * std / np.sqrt(2), np.array(std)
