"""Points over the models."""
