"""A client of the service, for programs: `Client` blocks, `AsyncClient` is for an event loop.

```python
from service.client import Client

with Client("http://127.0.0.1:8000") as client:
    job = client.wait(client.submit("tile.laz", crs="EPSG:28992"))
    client.fetch(job, "models")
```

It imports httpx and nothing of the engine. The commands `gablework submit`, `watch`, `fetch` and `jobs` use it.
"""

from service.client.client_answers import Event, FetchedFile, Job, Output, Problem, Submitted, Transfer
from service.client.client_errors import (
    BusyError,
    DamagedError,
    ForbiddenError,
    ForeignAnswerError,
    JobDismissedError,
    JobFailedError,
    NotFoundError,
    RefusedError,
    UnauthorizedError,
    UnreachableError,
)
from service.client.clients import AsyncClient, Client
from service.client.upload_memory import UploadMemory

__all__ = [
    "AsyncClient",
    "BusyError",
    "Client",
    "DamagedError",
    "Event",
    "FetchedFile",
    "ForbiddenError",
    "ForeignAnswerError",
    "Job",
    "JobDismissedError",
    "JobFailedError",
    "NotFoundError",
    "Output",
    "Problem",
    "RefusedError",
    "Submitted",
    "Transfer",
    "UnauthorizedError",
    "UnreachableError",
    "UploadMemory",
]
