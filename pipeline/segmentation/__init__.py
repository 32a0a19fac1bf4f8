"""Roof points to roof planes: one file per published segmentation."""
