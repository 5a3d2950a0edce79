"""CGSF: dense 3D scene flow from stereo video. Files, names and people; the conventions are in :mod:`variational`."""

__version__ = "0.1.0"
