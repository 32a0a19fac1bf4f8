"""The compiled toolkit: what kernels of all stages share, one published term a file.

Arguments have one type each, so that every tool is compiled once: arrays contiguous, int64 or float64, labels int32.
"""
