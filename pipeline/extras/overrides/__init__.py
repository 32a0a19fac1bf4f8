"""Corrections of single buildings."""
