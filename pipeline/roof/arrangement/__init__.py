"""Roof faces by an arrangement of lines: coarse labels, candidate lines, an adaptive subdivision, a minimum cut."""
