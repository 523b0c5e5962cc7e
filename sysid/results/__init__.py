"""The answer: the result of an identification, its summary, its file."""
