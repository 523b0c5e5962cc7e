"""The result of an identification."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sysid.results.answer import Answer, reported_unknowns
from sysid.results.summary import summary
from sysid.results.version import __version__
from sysid.structure.structure import Array


@dataclass(frozen=True)
class Recipe:
    """What rebuilds a problem elsewhere: its module and what was passed to ``problem()``.

    Attributes
    ----------
    module : str
        As given on the command line: a name, a path, or a dotted module.
    data : str or None
    rng : int
    """

    module: str
    data: str | None = None
    rng: int = 0


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Answer):
    """A structure identified from a base-shake test, and how far it can be trusted: see `Answer` for its figures.

    Attributes
    ----------
    recipe : Recipe or None
        Set where the problem came from a module.
    """

    recipe: Recipe | None = None

    def __repr__(self) -> str:
        word = "success" if self.success else "no success"
        known = "determined" if self.determined else "not determined"
        return f"<Identification: {word}, residual {self.residual:.3g}, {known}; {self.structure!r}>"

    def summary(self) -> str:
        """Table of the result, for a terminal."""
        return summary(self)

    def to_dict(self) -> dict[str, Any]:
        """The figures of ``summary.json``; None for what the data leave open or what was not computed."""
        u, n = self.quick_uncertainty, self.structure.n
        values, std = self.values, {} if u is None else u.variables
        reported = () if self.x is None else reported_unknowns(self.problem, damping_ratios=True)
        return {
            "problem": self.recipe.module if self.recipe else None,
            "strategy": self.strategy,
            "seed": self.seed,
            "success": bool(self.success),
            "message": self.message,
            "residual": self.residual,
            "residuals": list(self.residuals),
            "objective": self.objective,
            "force_residual": self.force_residual,
            "natural_frequencies_hz": self.structure.natural_frequencies.tolist(),
            "natural_frequencies_std_hz": _plain(np.full(n, np.nan) if u is None else u.natural_frequencies),
            "damping_ratios": self.structure.damping_ratios.tolist(),
            "damping_ratios_std": _plain(np.full(n, np.nan) if u is None else u.damping_ratios),
            "unknowns": {v.name: values[v.name].tolist() for v in reported},
            "unknowns_std": {v.name: _plain(std[v.name]) for v in reported if v.name in std},
            "unknown_units": {v.name: v.unit for v in reported},
            "total_mass_kg": np.diag(self.structure.rigid_body_mass).tolist(),
            "determined": bool(self.determined),
            "closed_by": list(self.closed_by),
            "undetermined": list(self.undetermined),
            "remarks": list(self.remarks),
            "evaluations": int(self.history.evaluations),
            "wall_time_s": float(self.history.wall_time),
            "version": __version__,
        }

    def save(self, path: str | Path) -> Path:
        """Write everything to an HDF5 file (no pickle inside); `sysid.load` reads it back."""
        from sysid.results.storage import save  # storage builds Identifications, so it cannot be above this room

        return save(self, path)


def _plain(values: Array) -> Any:
    """Numbers as lists of Python's, None for what is not finite."""
    return np.where(np.isfinite(values), values, None).tolist()
