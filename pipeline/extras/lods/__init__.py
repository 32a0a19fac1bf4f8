"""Other levels of detail."""
