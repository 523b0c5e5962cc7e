"""Worth of an answer: determination, uncertainty, checks."""
