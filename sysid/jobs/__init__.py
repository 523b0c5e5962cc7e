"""Refinement jobs: many starts and many problems, in this process, a pool of processes or a cluster."""

from sysid.jobs.engine import cluster, processes
from sysid.jobs.job import JobResult
from sysid.jobs.minima import Minimum, distinct
from sysid.jobs.spread import Spread, spreads
from sysid.jobs.submit import submit

__all__ = ["JobResult", "Minimum", "Spread", "cluster", "distinct", "processes", "spreads", "submit"]
