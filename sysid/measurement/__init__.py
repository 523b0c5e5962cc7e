"""Records and spectra of a base-shake test, and their noise."""
