"""Adaptive particle swarm: minimises any batched function over a box.

`minimize_swarm` runs a whole search; `ParticleSwarm` is the same search in ask and tell form, for callers that
evaluate the costs themselves, stop, store and go on.
"""

from .adaptation import EvolutionaryState, SwarmSettings
from .minimize import StopReason, SwarmProgress, minimize_swarm
from .particles import ParticleSwarm

__all__ = [
    "EvolutionaryState", "ParticleSwarm", "StopReason", "SwarmProgress", "SwarmSettings", "minimize_swarm",
]  # fmt: skip
