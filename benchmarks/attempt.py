"""An identification from the records alone, and what to call one that failed."""

from __future__ import annotations

import sysid


def identified(test: sysid.Measurement, mass: object = None) -> sysid.Identification:
    """Result of the modal strategy; nothing is given but the test and a model of the mass, a full one by default.

    It may raise anything: a line that measures a share of runs counts a crash as one that is not met, with
    `named` telling which, and goes on.
    """
    return sysid.identify(sysid.Problem(test, mass=mass or sysid.FullMass()), strategy="modal")


def named(error: Exception) -> str:
    """A crash by the name of its kind, a user's error by its sentence alone."""
    return str(error) if isinstance(error, sysid.InputError) else f"{type(error).__name__}: {error}"
