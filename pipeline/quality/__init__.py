"""How good a model is: validity of its solids, residuals of its points."""
