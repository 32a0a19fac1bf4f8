"""What only some runs ask for: one folder each, loaded through the tables that name it."""
