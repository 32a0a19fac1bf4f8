"""The driver: claims jobs, runs them on one cluster and records their progress. It is a separate process."""

from service.driver.process import Driver, run_driver

__all__ = ["Driver", "run_driver"]
