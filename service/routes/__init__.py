"""The paths of the service: one module a chapter of it, each with its `router`."""
