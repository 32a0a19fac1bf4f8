"""A finished run as outputs for download, and its buildings as pages of GeoJSON.

The driver writes (`write_outputs`), the front end only reads: what it needs for a page of buildings lies ready in
files, so that it loads no numerical library.
"""

from service.outputs.assemble import write_outputs
from service.outputs.catalogue import Catalogue, output_file, read_catalogue
from service.outputs.kinds import OUTPUTS, OutputKind

__all__ = ["OUTPUTS", "Catalogue", "OutputKind", "output_file", "read_catalogue", "write_outputs"]
