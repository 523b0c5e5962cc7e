"""Benchmarks of records as a laboratory makes them."""
