"""What channels record in the place of the structure's motion: late ones."""
