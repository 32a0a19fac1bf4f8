"""Roof planes to roof faces and closed solids."""
