"""Searches and jobs that are killed, interrupted or cut off."""
