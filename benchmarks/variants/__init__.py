"""Variants of the problem as modules: published cases with noise, modules from the README alone, authors' mistakes."""
