"""Triangulated irregular networks of scattered points."""
