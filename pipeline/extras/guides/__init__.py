"""Given lines of roofs."""
