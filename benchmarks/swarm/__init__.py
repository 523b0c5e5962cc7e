"""The published algorithm: from a base-shake test to a structural model, measured records and users' mistakes too."""
