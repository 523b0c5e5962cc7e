# %% [markdown]
# # Modes beyond the band
#
# A real structure has more modes than any test has lines, and its test has more sensors than modes, or fewer. You will
# see
#
# 1. a cantilever of 42 modes with four of them in the band, and eight accelerometers;
# 2. that mass, stiffness and damping of these four are determined, on four of the sensors;
# 3. what the modes above add, and how it is kept: residual modes;
# 4. the superelement that goes to whoever couples the structure to a launcher or a building, and what it is worth in
#    the band and beyond it.

# %%
import matplotlib.pyplot as plt
import numpy as np

import sysid

# %% [markdown]
# ## The test
#
# The bundled problem `cantilever_in_band` holds it: a steel tube of two metres with 12 kg beside its axis on top,
# shaken in x and y, the base force measured, 0.5 % noise. Its last line is a third of the way from the fourth mode to
# the fifth.

# %%
recipe = sysid.Recipe("cantilever_in_band")
problem = sysid.catalogue.build(recipe)
test = problem.measurement
print(f"{len(test.sensor_names)} sensors, {test.freq.size} lines from {test.freq[0]:.3g} to {test.freq[-1]:.3g} Hz")

# %% [markdown]
# ## The answer in the band

# %%
result = sysid.identify(problem, rng=0)
print(result.summary())

# %% [markdown]
# Four modes stand on four sensors, which a pivoted QR factorisation of the mode shapes chose;
# `strategy=sysid.Modal(sensors=[...])` takes yours. The other sensors follow by `recovery`:

# %%
structure = result.structure
print(result.degrees_of_freedom)
print(structure.recovery.round(3))

# %% [markdown]
# ## Residual modes
#
# What the fit needed beside these four are poles of a fit, not modes of the structure: their frequencies, damping and
# masses mean nothing by themselves. Leave them out, and the answer near the last line is wrong.

# %%
print("poles beyond the lines, Hz:", structure.residual.natural_frequencies.round(1))
alone = sysid.Structure(
    structure.mass, structure.stiffness, structure.damping_ratios, n_base=structure.n_base,
    recovery=structure.recovery, rigid_body=structure.rigid_body,
)  # fmt: skip
sensor, figure = -2, plt.figure(figsize=(8, 3.5))
plt.semilogy(test.freq, np.abs(test.response[0, sensor]), ".", color="0.7", label="measured")
plt.semilogy(test.freq, np.abs(structure.transmissibility(test.freq)[sensor, 0]), label="with residual modes")
plt.semilogy(test.freq, np.abs(alone.transmissibility(test.freq)[sensor, 0]), "--", label="four modes alone")
plt.xlabel("frequency, Hz")
plt.ylabel(f"{test.sensor_names[sensor]} over base x")
plt.legend()
plt.show()

# %% [markdown]
# ## The superelement
#
# Effective masses tell how much of the rigid-body mass moves in the four modes; the rest moves with the base, or in
# modes beyond the band. The Craig-Bampton form holds all of it, residual modes last, and
# `sysid.export(result, "model.op4")` or `"model.bdf"` writes it for Nastran.

# %%
form = structure.to_craig_bampton()
share = 100 * np.einsum("kii->i", structure.effective_masses) / np.diag(structure.rigid_body_mass)
print("effective masses of the four modes, % of the rigid-body mass:", share.round(1))
print(f"coordinates of the superelement: {len(form.mass) - structure.n_base} modal, {structure.n_base} of the base")

# %% [markdown]
# Its answer to a moving base is the structure's own. In the band it is the truth's within the noise; beyond the band
# nothing was measured, and it soon means nothing. The same cantilever without noise, up to its sixth mode, tells:

# %%
wide = sysid.catalogue.build(sysid.Recipe("cantilever_in_band", parameters={"noise": 0.0, "modes": 6})).measurement
true, found = wide.force[0, 0], structure.base_force(wide.freq)[0, 0]
figure = plt.figure(figsize=(8, 3.5))
plt.semilogy(wide.freq, np.abs(true), color="0.6", linewidth=3, label="truth")
plt.semilogy(wide.freq, np.abs(found), label="superelement")
plt.axvline(test.freq[-1], color="0.3", linestyle=":", label="last line of the test")
plt.xlabel("frequency, Hz")
plt.ylabel("base force for unit base x, kg")
plt.legend()
plt.show()
inside = wide.freq < test.freq[-1]
for where, at in (("in the band", inside), ("beyond it", ~inside)):
    print(f"{where}: error {np.linalg.norm((found - true)[at]) / np.linalg.norm(true[at]):.1e} of the base force")

# %% [markdown]
# ## What to remember
#
# - The answer holds for the band. State it with the matrices; exported files do.
# - Residual modes belong to the superelement, and to every response that you compare with a record.
# - Where the base force was not measured, modal masses stay open, in the band as elsewhere.
