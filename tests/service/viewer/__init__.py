"""A package, so that fixtures can last as long as its tests: one browser, and one service to look at."""
