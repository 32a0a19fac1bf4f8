"""The science and the runs: raw airborne LiDAR in, valid building models out."""

__version__ = "0.2.0"
