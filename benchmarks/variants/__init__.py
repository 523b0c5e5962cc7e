"""Variants of the problem as modules: published cases with noise, modules written from the README, authors' mistakes."""
