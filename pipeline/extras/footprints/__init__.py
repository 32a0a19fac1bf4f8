"""Given footprints."""
