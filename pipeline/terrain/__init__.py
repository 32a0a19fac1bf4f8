"""Scene to candidates: ground, wall facets, surfaces, the Z_avg height rule, vegetation."""
