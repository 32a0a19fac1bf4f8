"""Overrides: manual corrections of single buildings."""
