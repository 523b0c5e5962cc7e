"""Structures as numbers: matrices, modes, responses, frames of beams."""
