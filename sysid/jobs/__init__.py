"""Jobs: many starts, draws, parts of a test or problems, in this process, a pool of processes or a cluster."""

from sysid.jobs.changes import Band, NumberOfModes, WithoutRun, WithoutSensor
from sysid.jobs.engine import cluster, processes
from sysid.jobs.job import JobResult
from sysid.jobs.minima import Minimum, Spread, distinct, spreads
from sysid.jobs.score import Compared, Move, Score, moves, scored
from sysid.jobs.submission import submit

__all__ = [
    "Band", "Compared", "JobResult", "Minimum", "Move", "NumberOfModes", "Score", "Spread", "WithoutRun",
    "WithoutSensor", "cluster", "distinct", "moves", "processes", "scored", "spreads", "submit",
]  # fmt: skip
