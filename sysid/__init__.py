"""Mass, stiffness and damping matrices of a structure from shaker-table (base excitation) tests."""

import casadi as _casadi

from sysid import plot
from sysid._written import Known, Misfit
from sysid.damping import ModalDamping, ProportionalDamping
from sysid.errors import InputError, SolverError, SysidError
from sysid.identification import History, Identification, Recipe
from sysid.identify import Continuation, Modal, Progress, Swarm, identify
from sysid.mass import FullMass, KnownMass, LumpedMass
from sysid.measurement import Measurement, Sensor, rigid_body, simulate
from sysid.problem import Problem
from sysid.spectra import resample
from sysid.stiffness import ChainStiffness, SpectralStiffness
from sysid.storage import load
from sysid.structure import Structure
from sysid.swarm import SwarmSettings, minimize_swarm
from sysid.variables import Variable

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
