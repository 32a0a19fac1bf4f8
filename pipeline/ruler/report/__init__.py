"""Pages and pictures of evaluations, comparisons of methods, and epochs."""
