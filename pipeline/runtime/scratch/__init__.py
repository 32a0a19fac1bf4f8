"""Scratch: intermediate results, the keys that they are stored under, and when they expire."""
