"""Two runs of one place compared: which buildings are new, gone, raised, lowered, reshaped, unchanged.

Begin with `diff.py` (runs in, files out) and `comparing.py` (match, compare roofs, judge). `records.py` lists the
classes and columns of the result, `settings.py` the thresholds.
"""
