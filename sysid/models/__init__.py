"""The unknowns, and each matrix as variables and expressions."""
