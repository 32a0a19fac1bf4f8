"""Several methods over one scene."""
