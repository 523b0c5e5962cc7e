"""The least-squares problem: unknowns, matrices, terms, constraints."""
