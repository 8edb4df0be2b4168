"""From the scan lines of a stripe laser scanner to the patches, edges and surfaces of a part.

Names are resolved when they are first used, so that importing the package stays cheap and needs
neither Taichi nor Rerun nor MCAP.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from octoseg_ti.errors import DataError, MissingPackageError
    from octoseg_ti.evaluation import Scores, evaluate
    from octoseg_ti.files import read, read_segmentation, read_truth, write
    from octoseg_ti.params import Params, paper
    from octoseg_ti.pipeline import segment
    from octoseg_ti.types import Artefact, EdgeClass, Scans, Segmentation, SurfaceKind, Truth

__version__ = "0.1.0"

_HOME = {
    "Artefact": "types",
    "DataError": "errors",
    "EdgeClass": "types",
    "MissingPackageError": "errors",
    "Params": "params",
    "Scans": "types",
    "Scores": "evaluation",
    "Segmentation": "types",
    "SurfaceKind": "types",
    "Truth": "types",
    "evaluate": "evaluation",
    "paper": "params",
    "read": "files",
    "read_segmentation": "files",
    "read_truth": "files",
    "segment": "pipeline",
    "write": "files",
}

__all__ = [
    "Artefact",
    "DataError",
    "EdgeClass",
    "MissingPackageError",
    "Params",
    "Scans",
    "Scores",
    "Segmentation",
    "SurfaceKind",
    "Truth",
    "__version__",
    "evaluate",
    "paper",
    "read",
    "read_segmentation",
    "read_truth",
    "segment",
    "write",
]


def __getattr__(name: str) -> Any:
    """Import a public name from the module that holds it."""
    if name in _HOME:
        return getattr(import_module(f"octoseg_ti.{_HOME[name]}"), name)
    raise AttributeError(f"module 'octoseg_ti' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names."""
    return __all__
