"""Variants of the problem as modules: published cases with noise, variants by newcomers, mistakes of their authors."""
