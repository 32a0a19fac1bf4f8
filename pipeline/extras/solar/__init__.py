"""Solar figures."""
