"""A finished run, or a comparison of several, as outputs for download, and its buildings as pages of GeoJSON.

The driver writes (`write_outputs`, `write_comparison_outputs`), the front end only reads. Pages of buildings are
prepared in files, and the front end loads no numerical library.
"""

from service.outputs.assemble import write_outputs
from service.outputs.catalogue import Catalogue, output_file, read_catalogue, run_outputs
from service.outputs.classification import write_classification_outputs
from service.outputs.comparison_files import write_comparison_outputs
from service.outputs.echo import write_echo
from service.outputs.kinds import CLASSIFICATION_OUTPUTS, COMPARISON_OUTPUTS, ECHO_OUTPUTS, KINDS, OUTPUTS, OutputKind

__all__ = [
    "CLASSIFICATION_OUTPUTS",
    "COMPARISON_OUTPUTS",
    "ECHO_OUTPUTS",
    "KINDS",
    "OUTPUTS",
    "Catalogue",
    "OutputKind",
    "output_file",
    "read_catalogue",
    "run_outputs",
    "write_classification_outputs",
    "write_comparison_outputs",
    "write_echo",
    "write_outputs",
]
