"""Frames of beams, point masses and springs by finite elements (see `sysid.structure.frame`)."""

from sysid.structure.frame import Beam, Frame, PointMass, Section

__all__ = ["Beam", "Frame", "PointMass", "Section"]
