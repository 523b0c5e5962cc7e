"""Records as a laboratory makes them: whether verdicts and intervals hold, and what the records cannot tell."""
