"""The driver: claims jobs, runs them on one cluster and records their progress. A process of its own."""

from service.driver.process import Driver, run_driver

__all__ = ["Driver", "run_driver"]
