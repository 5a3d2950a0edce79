"""CGSF: dense 3D scene flow from stereo video. Files, names and people; the conventions are in :mod:`variational`.

Everything public is imported on first use, so that ``import cgsf`` costs nothing and never loads torch.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "Calibration": "cgsf.calibration",
    "InputError": "cgsf.errors",
    "SceneFlow": "cgsf.scene_flow",
    "estimate": "cgsf.pipelines",
    "open_dataset": "cgsf.datasets",
}

__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'cgsf' has no attribute {name!r}")
    return getattr(importlib.import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
