"""Records in time of base-shake tests, as a laboratory makes them."""
