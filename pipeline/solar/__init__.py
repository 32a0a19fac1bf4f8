"""Solar energy on roofs: what a roof plane sees of the sky, and how much of the sun's energy it receives in a year."""
