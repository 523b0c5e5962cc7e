"""Mass, stiffness and damping matrices of a structure from shaker-table (base excitation) tests."""

import casadi as _casadi

from sysid import plot
from sysid.errors import InputError, SolverError, SysidError
from sysid.identify import Continuation, Modal, Progress, Swarm, identify
from sysid.measurement.measurement import Measurement, Sensor, rigid_body, simulate
from sysid.measurement.spectra import resample
from sysid.models.damping import ModalDamping, ProportionalDamping
from sysid.models.mass import FullMass, KnownMass, LumpedMass
from sysid.models.stiffness import ChainStiffness, SpectralStiffness
from sysid.models.unknowns import Variable
from sysid.problem.blocks import Known, Misfit
from sysid.problem.problem import Problem
from sysid.results.identification import Identification, Recipe
from sysid.results.storage import load
from sysid.search.strategy import History
from sysid.structure.structure import Structure
from sysid.swarm import SwarmSettings, minimize_swarm

__version__ = "0.1.0"

# CasADi 3.8 warns once about its coming NumPy conventions unless one is chosen.
if hasattr(_casadi.GlobalOptions, "setNumpyMode"):
    _casadi.GlobalOptions.setNumpyMode(-1)  # as it always was, without the warning

__all__ = [
    "ChainStiffness", "Continuation", "FullMass", "History", "Identification", "InputError", "Known", "KnownMass",
    "LumpedMass", "Measurement", "Misfit", "Modal", "ModalDamping", "Problem", "Progress", "ProportionalDamping",
    "Recipe", "Sensor", "SolverError", "SpectralStiffness", "Structure", "Swarm", "SwarmSettings", "SysidError",
    "Variable", "identify", "load", "minimize_swarm", "plot", "resample", "rigid_body", "simulate",
]  # fmt: skip
