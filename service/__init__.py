"""The REST service, its job driver and the console script; imports pipeline, never the other way round."""
