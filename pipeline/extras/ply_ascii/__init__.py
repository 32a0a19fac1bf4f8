"""PLY and ASCII."""
