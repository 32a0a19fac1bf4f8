"""Child processes that model buildings, their supervision, and replay bundles of buildings that harm them."""
