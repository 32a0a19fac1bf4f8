"""Reading points and footprints, and where bytes live."""
