"""Tests with one mistake in them, and whether results name it."""
