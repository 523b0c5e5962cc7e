"""Structures whose modes change with amplitude."""
