"""Files and arguments that nobody should have given."""
