"""The hierarchical ground filter."""
