"""The modal estimate: what it costs beside an older commit."""
