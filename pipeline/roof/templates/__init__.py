"""Roof templates for few points: flat, pent, gable, hip and half-hip over the parts of an outline, chosen by BIC."""
