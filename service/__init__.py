"""The console script and, later, the REST service; imports pipeline, never the other way round."""
