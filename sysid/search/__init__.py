"""Strategies and their phases."""
