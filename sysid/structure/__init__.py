"""Structures in numbers: matrices, modes, responses, frames of beams."""
