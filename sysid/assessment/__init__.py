"""What the answer is worth: determination, uncertainty, checks."""
