"""The ruler: how good are models, and what changed between two runs? The way from tile to models never imports it.

`simulation` makes scenes with exact truth and scans them. `evaluation` measures models of any program against that
truth or against classified points. `epochs` compares two runs of one place. `report` writes the pages of all three.

Begin with `simulation/dataset.py` (`simulate`), `evaluation/evaluate.py` (`evaluate`, the list of all measures) and
`epochs/diff.py` (`diff`). docs/reference/measures.md defines every measure.
"""
