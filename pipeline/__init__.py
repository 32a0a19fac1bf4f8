"""The science and the runs: raw airborne LiDAR in, valid building models out."""

__version__ = "0.1.0"
