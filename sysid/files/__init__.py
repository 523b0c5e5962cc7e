"""Readers of measured records, one module a format; `tree` is the container of stored results."""
