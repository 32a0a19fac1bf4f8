"""Party walls."""
