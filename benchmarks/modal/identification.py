"""An identification from the records alone, the text of one that failed, and how far its matrices are off."""

from __future__ import annotations

import numpy as np

import sysid


def identify_records(test: sysid.Measurement, mass: object = None) -> sysid.Identification:
    """Result of the modal strategy; nothing is given but the test and a model of the mass, a full one by default.

    It may raise anything: a line that measures a share of runs counts a crash as one that is not met, with
    `error_text` for its reason, and goes on.
    """
    return sysid.identify(sysid.Problem(test, mass=mass or sysid.FullMass()), strategy="modal")


def error_text(error: Exception) -> str:
    """The sentence of a user's error; the kind and the sentence of any other."""
    return str(error) if isinstance(error, sysid.InputError) else f"{type(error).__name__}: {error}"


def matrix_distance(found: sysid.Structure, truth: sysid.Structure) -> float:
    """Largest relative distance of M_SS, K_SS and C (Frobenius)."""
    n = truth.n
    pairs = (
        (found.mass[:n, :n], truth.mass[:n, :n]),
        (found.stiffness[:n, :n], truth.stiffness[:n, :n]),
        (found.damping, truth.damping),
    )
    return max(float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in pairs)
