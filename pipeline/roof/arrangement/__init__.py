"""Roof faces by an arrangement of lines: coarse labels, candidate lines, an adaptive subdivision, a minimum cut."""

from pipeline.roof.arrangement.arranging import arrange
from pipeline.roof.arrangement.settings import ArrangementSettings

__all__ = ["ArrangementSettings", "arrange"]
