"""Measured claims: what each capability must reach, and what it does reach."""
