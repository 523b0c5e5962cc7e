"""Mass, stiffness and damping matrices of a structure from shaker-table (base excitation) tests."""

from sysid.cli import starting as _starting  # noqa: F401 - first: what follows takes a sixth of a second

# isort: split
import importlib as _importlib
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

import casadi as _casadi

from sysid.errors import InputError, SolverError, SysidError
from sysid.export.export import export
from sysid.identify import identify
from sysid.measurement.excited_band import excited_band
from sysid.measurement.in_time import TimeScores, time_scores
from sysid.measurement.measurement import Measurement, Sensor
from sysid.measurement.simulation import simulate
from sysid.measurement.spectra import resample
from sysid.measurement.whole import NoiseLevels
from sysid.models.mass import FullMass, KnownMass, LumpedMass
from sysid.models.model import MassBlocks, MatrixModel, Stated, StiffnessBlocks, Totals
from sysid.models.stiffness_and_damping import ChainStiffness, ModalDamping, ProportionalDamping, SpectralStiffness
from sysid.models.unknowns import Unknown, Variable
from sysid.problem.problem import Problem
from sysid.problem.terms import FurtherTest, Prior, real_and_imaginary
from sysid.results.identification import Identification, Recipe, load
from sysid.results.version import __version__
from sysid.search.continuation import Continuation
from sysid.search.modal import Modal
from sysid.search.session import Progress
from sysid.search.strategy import History
from sysid.search.swarm import Swarm
from sysid.structure.amplitude import AmplitudeLaw, FittedLaw
from sysid.structure.sensor import rigid_body
from sysid.structure.structure import Structure
from sysid.structure.superelement import ResidualModes
from sysid.swarm import SwarmSettings, minimize_swarm

# CasADi 3.8 warns once about its coming NumPy conventions unless one is chosen.
if hasattr(_casadi.GlobalOptions, "setNumpyMode"):
    _casadi.GlobalOptions.setNumpyMode(-1)  # as it always was, without the warning

if _TYPE_CHECKING:
    from sysid import catalogue, jobs, plot
    from sysid.files.reading import read
    from sysid.report.report import write_report

_FIRST_USED = {
    "catalogue": "sysid.catalogue",
    "jobs": "sysid.jobs",
    "plot": "sysid.plot",
    "read": "sysid.files.reading",
    "write_report": "sysid.report.report",
}


def __getattr__(name: str) -> _Any:
    """Import what takes long to import, and many sessions do without, where it is first asked for."""
    if name not in _FIRST_USED:
        raise AttributeError(f"module 'sysid' has no attribute {name!r}")
    module = _importlib.import_module(_FIRST_USED[name])
    return getattr(module, name, module)


def __dir__() -> list[str]:
    return __all__


__all__ = [
    "AmplitudeLaw",
    "ChainStiffness",
    "Continuation",
    "FittedLaw",
    "FullMass",
    "FurtherTest",
    "History",
    "Identification",
    "InputError",
    "KnownMass",
    "LumpedMass",
    "MassBlocks",
    "MatrixModel",
    "Measurement",
    "Modal",
    "ModalDamping",
    "NoiseLevels",
    "Prior",
    "Problem",
    "Progress",
    "ProportionalDamping",
    "Recipe",
    "ResidualModes",
    "Sensor",
    "SolverError",
    "SpectralStiffness",
    "Stated",
    "StiffnessBlocks",
    "Structure",
    "Swarm",
    "SwarmSettings",
    "SysidError",
    "TimeScores",
    "Totals",
    "Unknown",
    "Variable",
    "__version__",
    "catalogue",
    "excited_band",
    "export",
    "identify",
    "jobs",
    "load",
    "minimize_swarm",
    "plot",
    "read",
    "real_and_imaginary",
    "resample",
    "rigid_body",
    "simulate",
    "time_scores",
    "write_report",
]  # fmt: skip
