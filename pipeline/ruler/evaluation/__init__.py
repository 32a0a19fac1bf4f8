"""Models of any program measured against a reference: simulated truth, or classified points with or without footprints.

`reading/` turns files into `models.py`; `reference_truth.py` and `reference_points.py` read what they are measured
against. Begin with `evaluate.py`, which calls one module per group of measures; `building_matching.py` decides which
model is of which building, `bootstrap.py` computes the intervals, `evaluation_writing.py` writes tables and Markdown.
"""
