"""Roof points to roof planes: one file a published segmentation."""
