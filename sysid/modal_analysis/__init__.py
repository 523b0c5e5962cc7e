"""What records show without mass and stiffness: poles, residues, modes."""
