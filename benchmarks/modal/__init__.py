"""Identification from the records alone: how exact it is, what it says of its errors, and what it cannot know."""
