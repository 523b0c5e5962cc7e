"""Continuous structures, with more modes than the band, by a finite-element code of their own."""
