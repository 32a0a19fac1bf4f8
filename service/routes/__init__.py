"""The routes of the service: one module per chapter, each with its `router`."""
