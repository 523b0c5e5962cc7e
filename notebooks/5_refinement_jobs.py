# %% [markdown]
# # Refinement jobs
#
# A search ends in a minimum. Whether there is another one that explains the records as well, or better, is a question
# to ask many starts. You will see
#
# 1. what a job is: a recipe, from which any worker builds the problem anew;
# 2. many starts, in this process and in two others, with the same bits;
# 3. the distinct minima, and how often each was reached;
# 4. that nothing is computed twice.

# %%
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import sysid

# %% [markdown]
# ## A recipe
#
# Three floors of which only the amplitudes of the transmissibility were kept. Without phase a gradient may well end in
# the wrong place. The problem is the bundled module `magnitude_only`; yours would be `Recipe("my_building.py")`. It is
# named, never sent: a problem that lives in a notebook cell cannot be rebuilt by a worker, so save it as a module.

# %%
recipe = sysid.Recipe("magnitude_only")
problem = sysid.catalogue.build(recipe)
result = sysid.identify(problem, rng=0)
print(result.residual, result.success)

# %% [markdown]
# ## Many starts
#
# Start 0 is the recipe's own `start`, here the result; all others are fresh points of the search space, each with a
# seed of its own. The iterator gives results as they come.

# %%
recipe = replace(recipe, start=result.x)
folder = Path(tempfile.mkdtemp())
ends = list(sysid.jobs.submit(recipe, starts=5, out=folder))
for end in ends:
    print(end.index, end.success, f"{end.residual:.2e}", end.message[:60])

# %% [markdown]
# ## Distinct minima
#
# Ends are one minimum where all unknowns agree to a thousandth of their size. A worse one that was reached often is a
# warning for whoever starts at one point only; a second one that fits alike would mean that the data do not tell them
# apart. `sysid refine results/NAME --starts 8` does all of this from the command line.

# %%
minima = sysid.jobs.distinct(problem, ends)
for minimum in minima:
    print(f"residual {minimum.residual:.2e}, reached {len(minimum.results)} times, x = {minimum.best.x.round(1)}")
sysid.plot.minima(minima, "magnitude_only", goal=problem.goal)

# %% [markdown]
# ## On several processors, and never twice
#
# `processes(2)` makes pools of two workers; where one dies another pool takes its place. The results are the same bits.
# Those that stand in the folder of the jobs are not computed again.

# %%
again = list(sysid.jobs.submit(recipe, starts=6, executor=sysid.jobs.processes(2), out=folder))
assert all(np.array_equal(one.x, other.x) for one, other in zip(ends, again[:5], strict=True))
print([end.index for end in again[5:]])
