"""Modal analysis of records, without mass and stiffness: poles, residues, modes."""
