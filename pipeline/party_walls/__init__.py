"""Party walls: where walls of two buildings touch, and what is left of each wall."""
