"""Classified points."""
