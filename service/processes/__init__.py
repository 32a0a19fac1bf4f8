"""The processes that the service offers: what they take and give, and how what a client sends becomes a request."""

from service.processes.table import PROCESSES, Process, process_named

__all__ = ["PROCESSES", "Process", "process_named"]
