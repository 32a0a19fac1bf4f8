"""Two runs of one place compared: which buildings are new, gone, raised, lowered, reshaped, unchanged.

Begin with `diff.py` (runs in, files out) and `epoch_comparison.py` (match, compare roofs, judge). `change_records.py`
lists the classes and columns of the result, `epoch_settings.py` the thresholds.
"""
