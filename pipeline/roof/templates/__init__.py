"""Roof templates for few points: flat, pent, gable, hip and half-hip over the parts of an outline, chosen by BIC."""

from pipeline.roof.templates.fitting import MAX_POINTS, RankedFaces, Templates, fit_templates, margin_of_templates

__all__ = ["MAX_POINTS", "RankedFaces", "Templates", "fit_templates", "margin_of_templates"]
