"""Batch runs: a file that says what is to be done, a work folder that remembers, a status that anyone can read."""
