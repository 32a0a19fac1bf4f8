"""The ruler: simulated scenes with exact truth, evaluation of models, comparison of epochs, and their reports."""
